// SPDX-License-Identifier: Apache-2.0
// The MPU6050's self-test: register map RM-MPU-6000A, section 4.1.
#pragma once

#include <stdint.h>

struct Mpu6050TrimCodes {
    uint8_t accel[3];
    uint8_t gyro[3];
};

// Reads the codes out of registers 0x0D to 0x10.
void mpu6050_trim_codes(const uint8_t *registers, Mpu6050TrimCodes *codes);

// Factory trim in counts, at +-8 g and +-250 deg/s; 0 for code 0. Positive for every axis: the
// gyroscope's y axis answers with the opposite sign.
uint16_t mpu6050_accel_trim(uint8_t code);
uint16_t mpu6050_gyro_trim(uint8_t code);

// Whether a self-test response lies within 14 % of its factory trim; without one (code 0) the
// response proves nothing and passes.
bool mpu6050_response_ok(int32_t response, uint16_t trim);
