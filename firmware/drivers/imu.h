// SPDX-License-Identifier: Apache-2.0
// Accelerometer and gyroscope: the MPU6050 and every chip with its register map, and the bypass to
// the compass behind it. Register maps RM-MPU-6000A revision 4.2 and RM-MPU-6500A revision 2.1.
//
// Boards sold with an "MPU6050" carry MPU6500, MPU9250, ICM-20689 or unnamed clones. So the chip's
// behaviour decides whether it is used, not its WHO_AM_I: it wakes up, keeps the ranges that are
// written to it, and delivers data that moves. The id is reported, and it selects the temperature
// scale and the self-test (common/imu_chip.h).
#pragma once

#include <stdint.h>

constexpr uint8_t IMU_ADDRESS = 0x68;
constexpr uint8_t IMU_DATA = 0x3B;
constexpr uint8_t IMU_DATA_SIZE = 14;

// Resets the chip; takes up to 0.1 s.
bool imu_reset();

// Wakes the chip, opens the bypass, sets rate, ranges, filters and data-ready interrupt, and reads
// them back; takes about 2 ms. `id` is the chip's WHO_AM_I.
bool imu_set_up(uint8_t *id);

// Whether the self-test response of every axis is within its limits; takes about 0.2 s and needs
// imu_set_up before it. The board must be at rest.
bool imu_self_test(uint8_t id);
