// SPDX-License-Identifier: Apache-2.0
// HMC5883L magnetometer, behind the MPU6050's bypass. Datasheet 900405 revision E.
#pragma once

#include <stdint.h>

constexpr uint8_t HMC5883L_ADDRESS = 0x1E;
// The configuration and, behind it, the data.
constexpr uint8_t HMC5883L_FROM = 0x00;
constexpr uint8_t HMC5883L_SIZE = 9;

// Identifies the chip and sets 75 readings a second, each the mean of eight.
bool hmc5883l_set_up();

// Reads the nine bytes from 0x00, whose axes come in the order x, z, y. False if the chip has lost its
// set-up, as after a dip of its supply: it answers then, with one reading for ever.
bool hmc5883l_read_bytes(const uint8_t *bytes, int16_t mag[3]);
