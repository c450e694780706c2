// SPDX-License-Identifier: Apache-2.0
// BMP180 barometer. Datasheet BST-BMP180-DS000 revision 2.5.
#pragma once

#include <stdint.h>

#include "common/bmp180_math.h"

constexpr uint8_t BMP180_ADDRESS = 0x77;
constexpr uint8_t BMP180_RESULT = 0xF6;
constexpr uint8_t BMP180_CONTROL = 0xF4;

constexpr uint8_t BMP180_CONVERT_TEMPERATURE = 0x2E;
constexpr uint32_t BMP180_TEMPERATURE_US = 4500;

constexpr uint8_t bmp180_convert_pressure(uint8_t oversampling) {
    return static_cast<uint8_t>(0x34 | oversampling << 6);
}

// Conversion time of a pressure, section 3.3.1.
constexpr uint32_t bmp180_pressure_us(uint8_t oversampling) {
    return oversampling == 0 ? 4500 : oversampling == 1 ? 7500 : oversampling == 2 ? 13500 : 25500;
}

// Identifies the chip and reads its calibration words.
bool bmp180_set_up(Bmp180Words *words);
