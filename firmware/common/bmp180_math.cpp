// SPDX-License-Identifier: Apache-2.0
#include "common/bmp180_math.h"

bool bmp180_read_words(const uint8_t *bytes, Bmp180Words *words) {
    uint16_t read[BMP180_WORDS_SIZE / 2];
    for (uint8_t i = 0; i < BMP180_WORDS_SIZE / 2; ++i) {
        read[i] = static_cast<uint16_t>(bytes[2 * i] << 8 | bytes[2 * i + 1]);
        if (read[i] == 0 || read[i] == 0xFFFF) {
            return false;
        }
    }
    words->ac1 = static_cast<int16_t>(read[0]);
    words->ac2 = static_cast<int16_t>(read[1]);
    words->ac3 = static_cast<int16_t>(read[2]);
    words->ac4 = read[3];
    words->ac5 = read[4];
    words->ac6 = read[5];
    words->b1 = static_cast<int16_t>(read[6]);
    words->b2 = static_cast<int16_t>(read[7]);
    words->mb = static_cast<int16_t>(read[8]);
    words->mc = static_cast<int16_t>(read[9]);
    words->md = static_cast<int16_t>(read[10]);
    return true;
}

int32_t bmp180_b5(const Bmp180Words *words, uint16_t raw) {
    const int32_t x1 =
        static_cast<int32_t>((static_cast<int64_t>(raw) - words->ac6) * words->ac5 >> 15);
    const int32_t divisor = x1 + words->md;
    if (divisor == 0) {
        return x1;
    }
    return x1 + static_cast<int32_t>(words->mc) * 2048 / divisor;
}

int16_t bmp180_temperature_ddegc(int32_t b5) { return static_cast<int16_t>((b5 + 8) >> 4); }

uint32_t bmp180_pressure_centipa(const Bmp180Words *words, int32_t b5, uint32_t raw,
                                 uint8_t oversampling) {
    const int32_t b6 = b5 - 4000;
    const int32_t b6_squared = static_cast<int32_t>(static_cast<int64_t>(b6) * b6 >> 12);
    int32_t x1 = static_cast<int32_t>(static_cast<int64_t>(words->b2) * b6_squared >> 11);
    int32_t x2 = static_cast<int32_t>(static_cast<int64_t>(words->ac2) * b6 >> 11);
    const int32_t b3 =
        (((static_cast<int32_t>(words->ac1) * 4 + x1 + x2) << oversampling) + 2) / 4;
    x1 = static_cast<int32_t>(static_cast<int64_t>(words->ac3) * b6 >> 13);
    x2 = static_cast<int32_t>(static_cast<int64_t>(words->b1) * b6_squared >> 16);
    const int32_t x3 = (x1 + x2 + 2) >> 2;
    const uint32_t b4 = static_cast<uint32_t>(
        static_cast<uint64_t>(words->ac4) * static_cast<uint32_t>(x3 + 32768) >> 15);
    if (b4 == 0) {
        return 0;
    }
    const uint64_t b7 = static_cast<uint64_t>(raw - static_cast<uint32_t>(b3)) * (50000UL >> oversampling);
    const uint32_t centipa = static_cast<uint32_t>(b7 * 200 / b4);
    const int32_t p = static_cast<int32_t>(centipa / 100);
    const int32_t p_high = p >> 8;
    x1 = static_cast<int32_t>(static_cast<int64_t>(p_high * p_high) * 3038 >> 16);
    x2 = static_cast<int32_t>(static_cast<int64_t>(-7357) * p >> 16);
    return centipa + static_cast<uint32_t>((x1 + x2 + 3791) * 100 / 16);
}
