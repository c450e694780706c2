// SPDX-License-Identifier: Apache-2.0
// Differences between the chips that share the MPU6050's data registers: temperature scale and
// factory self-test. Register maps RM-MPU-6000A, RM-MPU-6500A and DS-000143 (ICM-20689).
#pragma once

#include <stdint.h>

constexpr uint8_t IMU_AXES = 6;  // accelerometer x, y, z, gyroscope x, y, z

enum ImuFamily : uint8_t {
    IMU_MPU6050,  // WHO_AM_I 0x68
    IMU_MPU6500,  // 0x70, 0x71 (MPU9250), 0x73 (MPU9255), 0x74 (MPU6515)
    IMU_ICM20689, // 0x98, 0x12 (ICM-20602), 0x19 (MPU6886), 0xAF (ICM-20608)
    IMU_UNKNOWN,  // any other id: used alike, its self-test is not evaluated
};

ImuFamily imu_family(uint8_t id);

// The temperature word on the MPU6050's scale: degC = counts / 340 + 36.53.
int16_t imu_temperature(ImuFamily family, int16_t raw);

// Where a family keeps its factory codes, and at which ranges its self-test is defined. The
// gyroscope's range is +-250 deg/s in every family.
struct ImuSelfTest {
    uint8_t gyro_codes;   // first register of the gyroscope's codes, if apart from the other's
    uint8_t accel_codes;  // first register of the accelerometer's codes, or of all of them
    uint8_t accel_range;
};

ImuSelfTest imu_self_test_of(ImuFamily family);

// Expected responses in counts, in the order of IMU_AXES, 0 where the chip has no code. `codes` are
// the four registers from accel_codes and the three from gyro_codes.
void imu_expected_responses(ImuFamily family, const uint8_t accel_codes[4],
                            const uint8_t gyro_codes[3], uint16_t expected[IMU_AXES]);

// Whether a response (self-test on less off) fits its expected value; without one it proves nothing
// and passes.
bool imu_response_ok(ImuFamily family, int32_t response, uint16_t expected);
