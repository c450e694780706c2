// SPDX-License-Identifier: Apache-2.0
// HMC5883L magnetometer, behind the MPU6050's bypass. Datasheet 900405 revision E.
#pragma once

#include <stdint.h>

constexpr uint8_t HMC5883L_ADDRESS = 0x1E;
constexpr uint8_t HMC5883L_DATA = 0x03;
constexpr uint8_t HMC5883L_DATA_SIZE = 6;

// Identifies the chip and sets 75 readings a second, each the mean of eight.
bool hmc5883l_set_up();

// Reads the six bytes from 0x03, which come in the order x, z, y.
void hmc5883l_read_bytes(const uint8_t *bytes, int16_t mag[3]);
