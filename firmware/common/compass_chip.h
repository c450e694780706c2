// SPDX-License-Identifier: Apache-2.0
// The compass chips that share one footprint, and their registers as field on one set of axes: those
// of the HMC5883L, which are printed on a GY-87. A QMC5883L in its place has the same axes. In a
// QMC5883P, after the datasheet's write to its register 0x29,
//     x = -y, y = -x, z = -z  (HMC5883L = QMC5883P).
// Datasheets: HMC5883L 900405 revision E, QMC5883L 13-52-04 revision A, QMC5883P 13-52-19 revision C.
#pragma once

#include <stdint.h>

#include "common/wire.h"
#include "settings.h"

// HMC5983 and DA5883 have the identification and the registers of the HMC5883L. The status register
// of a DA5883 never shows new data, so nobody reads it.
constexpr uint8_t HMC5883L_ADDRESS = 0x1E;
constexpr uint8_t QMC5883L_ADDRESS = 0x0D;
constexpr uint8_t QMC5883P_ADDRESS = 0x2C;

constexpr uint8_t HMC5883L_CONFIG_A = 3 << 5 | 6 << 2;  // the mean of 8, at 75 Hz
constexpr uint8_t HMC5883L_CONFIG_B = MAG_GAIN << 5;
constexpr uint8_t HMC5883L_CONTINUOUS = 0;
constexpr uint8_t QMC5883L_CONTROL = 1 << 4 | 3 << 2 | 1;      // +-8 G, 200 Hz, continuous
constexpr uint8_t QMC5883P_CONTROL_1 = 3 << 6 | 3 << 2 | 1;    // 200 Hz, normal mode
constexpr uint8_t QMC5883P_CONTROL_2 = 2 << 2;                 // +-8 G, set and reset on

// One transfer brings the data and the chip's configuration, which shows whether it is still set up.
struct CompassChip {
    uint8_t address;
    uint8_t from;
    uint8_t size;
    uint8_t scale;  // code in the IMU payload
};

constexpr uint8_t COMPASS_CHIPS = 3;
constexpr uint8_t COMPASS_SIZE_MAX = 11;

// In the order in which they are looked for.
constexpr CompassChip COMPASS_CHIP[COMPASS_CHIPS] = {
    {HMC5883L_ADDRESS, 0x00, 9, MAG_GAIN},
    {QMC5883L_ADDRESS, 0x00, 10, WIRE_MAG_QMC5883L_8G},
    {QMC5883P_ADDRESS, 0x01, 11, WIRE_MAG_QMC5883P_8G},
};

// Reads one transfer into x, y, z; WIRE_MAG_OVERFLOW on the axes beyond the chip's range. False if
// the chip has lost its set-up, as after a dip of its supply: it then repeats one reading.
bool compass_read_bytes(const CompassChip &chip, const uint8_t *bytes, int16_t mag[3]);
