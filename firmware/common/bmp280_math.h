// SPDX-License-Identifier: Apache-2.0
// Compensation of the BMP280 and of the BME280's pressure: datasheet BST-BMP280-DS001, section 3.11
// and appendix 8.2, in 64-bit integers.
#pragma once

#include <stdint.h>

constexpr uint8_t BMP280_WORDS_SIZE = 24;

struct Bmp280Words {
    uint16_t t1;
    int16_t t2, t3;
    uint16_t p1;
    int16_t p2, p3, p4, p5, p6, p7, p8, p9;
};

// Reads the 24 little-endian bytes at 0x88. False if T1 or P1 is 0 or 0xFFFF: the bus or the chip is
// broken.
bool bmp280_read_words(const uint8_t *bytes, Bmp280Words *words);

// Reads six bytes from 0xF7. False if a measurement was skipped or out of the chip's range.
bool bmp280_read_raw(const uint8_t *bytes, uint32_t *raw_pressure, uint32_t *raw_temperature);

// The datasheet's t_fine, which both results need.
int32_t bmp280_t_fine(const Bmp280Words *words, uint32_t raw);

// In 0.1 degC.
int16_t bmp280_temperature_ddegc(int32_t t_fine);

// In 0.01 Pa.
uint32_t bmp280_pressure_centipa(const Bmp280Words *words, int32_t t_fine, uint32_t raw);
