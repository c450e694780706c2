// SPDX-License-Identifier: Apache-2.0
// MPU6050: accelerometer, gyroscope, and the bypass to the magnetometer behind it. Register map
// RM-MPU-6000A revision 4.2.
#pragma once

#include <stdint.h>

constexpr uint8_t MPU6050_ADDRESS = 0x68;
constexpr uint8_t MPU6050_DATA = 0x3B;
constexpr uint8_t MPU6050_DATA_SIZE = 14;

// Resets the chip; takes up to 0.1 s.
bool mpu6050_reset();

// Sets rate, ranges, filter, data-ready interrupt and bypass; takes about 2 ms.
bool mpu6050_set_up();

// Whether the self-test response of every axis is within its limits; takes about 0.2 s and needs
// mpu6050_set_up behind it. The board must be at rest.
bool mpu6050_self_test();
