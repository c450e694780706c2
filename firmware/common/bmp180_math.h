// SPDX-License-Identifier: Apache-2.0
// Compensation of the BMP180: datasheet BST-BMP180-DS000, section 3.5, with the pressure carried
// to a hundredth of a pascal instead of a whole one.
#pragma once

#include <stdint.h>

constexpr uint8_t BMP180_WORDS_SIZE = 22;

struct Bmp180Words {
    int16_t ac1, ac2, ac3;
    uint16_t ac4, ac5, ac6;
    int16_t b1, b2, mb, mc, md;
};

// Reads the 22 big-endian bytes at 0xAA. False if one word is 0 or 0xFFFF: then the bus or the
// chip is broken, as the datasheet says.
bool bmp180_read_words(const uint8_t *bytes, Bmp180Words *words);

// The datasheet's B5, which both results need. `raw` is the uncompensated temperature.
int32_t bmp180_b5(const Bmp180Words *words, uint16_t raw);

// In 0.1 degC.
int16_t bmp180_temperature_ddegc(int32_t b5);

// In 0.01 Pa. `raw` is the uncompensated pressure of 16 + oversampling bits.
uint32_t bmp180_pressure_centipa(const Bmp180Words *words, int32_t b5, uint32_t raw,
                                 uint8_t oversampling);
