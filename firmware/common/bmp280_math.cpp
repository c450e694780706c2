// SPDX-License-Identifier: Apache-2.0
#include "common/bmp280_math.h"

#include <string.h>

namespace {

constexpr uint32_t SKIPPED = 0x80000;

uint32_t raw_of(const uint8_t *bytes) {
    return static_cast<uint32_t>(bytes[0]) << 12 | static_cast<uint32_t>(bytes[1]) << 4 | bytes[2] >> 4;
}

bool possible(uint16_t word) { return word != 0 && word != 0xFFFF; }

}  // namespace

bool bmp280_read_words(const uint8_t *bytes, Bmp280Words *words) {
    static_assert(sizeof *words == BMP280_WORDS_SIZE, "the words stand in the chip's order");
    memcpy(words, bytes, sizeof *words);  // both are little-endian
    return possible(words->t1) && possible(words->p1);
}

bool bmp280_read_raw(const uint8_t *bytes, uint32_t *raw_pressure, uint32_t *raw_temperature) {
    *raw_pressure = raw_of(bytes);
    *raw_temperature = raw_of(bytes + 3);
    return *raw_pressure != SKIPPED && *raw_temperature != SKIPPED && *raw_pressure != 0 &&
           *raw_temperature != 0;
}

int32_t bmp280_t_fine(const Bmp280Words *words, uint32_t raw) {
    const int32_t t1 = words->t1;
    const int32_t coarse = static_cast<int32_t>(raw >> 3) - 2 * t1;
    const int32_t fine = static_cast<int32_t>(raw >> 4) - t1;
    const int64_t linear = static_cast<int64_t>(coarse) * words->t2 >> 11;
    const int64_t square = (static_cast<int64_t>(fine) * fine >> 12) * words->t3 >> 14;
    return static_cast<int32_t>(linear + square);
}

int16_t bmp280_temperature_ddegc(int32_t t_fine) {
    return static_cast<int16_t>((t_fine * 5 + 1280) / 2560);
}

uint32_t bmp280_pressure_centipa(const Bmp280Words *words, int32_t t_fine, uint32_t raw) {
    const int64_t t = static_cast<int64_t>(t_fine) - 128000;
    const int64_t t_squared = t * t;
    const int64_t offset = t_squared * words->p6 + t * words->p5 * (1LL << 17) +
                           words->p4 * (1LL << 35);
    const int64_t gain = (t_squared * words->p3 >> 8) + t * words->p2 * (1LL << 12);
    const int64_t divisor = ((1LL << 47) + gain) * words->p1 >> 33;
    if (divisor == 0) {
        return 0;
    }
    int64_t p = static_cast<int64_t>(1048576 - raw) * (1LL << 31);
    p = (p - offset) * 3125 / divisor;
    const int64_t p_high = p >> 13;
    const int64_t square = words->p9 * p_high * p_high >> 25;
    const int64_t linear = words->p8 * p >> 19;
    p = ((p + square + linear) >> 8) + words->p7 * 16L;  // in Pa / 256
    return p < 0 ? 0 : static_cast<uint32_t>(p * 25 / 64);
}
