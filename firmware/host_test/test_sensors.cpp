// SPDX-License-Identifier: Apache-2.0
// BMP180 compensation and the MPU6050's self-test against their datasheets.
#include <cmath>
#include <cstdint>

#include "common/bmp180_math.h"
#include "common/mpu6050_math.h"
#include "host_test/check.h"

namespace {

// The example of the BMP180 datasheet, section 3.5.
constexpr Bmp180Words EXAMPLE = {408,   -72,  -14383, 32741, 32757, 23153,
                                 6190,  4,    -32768, -8711, 2868};

}  // namespace

TEST(bmp180_gives_the_datasheets_example) {
    const int32_t b5 = bmp180_b5(&EXAMPLE, 27898);
    CHECK_NEAR(b5, 2399, 1);  // the datasheet rounds its quotient, the chip code truncates it
    CHECK(bmp180_temperature_ddegc(b5) == 150);
    CHECK_NEAR(bmp180_pressure_centipa(&EXAMPLE, b5, 23843, 0), 6996400, 100);
}

TEST(bmp180_resolves_less_than_a_pascal_at_full_oversampling) {
    const int32_t b5 = bmp180_b5(&EXAMPLE, 27898);
    const uint32_t raw = 23843UL << 3;
    uint32_t before = bmp180_pressure_centipa(&EXAMPLE, b5, raw, 3);
    CHECK_NEAR(before, 6996400, 400);
    for (uint32_t step = 1; step < 200; ++step) {
        const uint32_t now = bmp180_pressure_centipa(&EXAMPLE, b5, raw + step, 3);
        CHECK(now > before && now - before < 100);
        before = now;
    }
}

TEST(bmp180_pressure_rises_with_the_reading_over_the_whole_range) {
    for (const int raw_temperature : {20000, 27898, 34000}) {
        const int32_t b5 = bmp180_b5(&EXAMPLE, static_cast<uint16_t>(raw_temperature));
        uint32_t before = 0;
        for (uint32_t raw = 8000; raw < 48000; raw += 400) {
            const uint32_t now = bmp180_pressure_centipa(&EXAMPLE, b5, raw << 3, 3);
            CHECK(now > before);
            before = now;
        }
    }
}

TEST(bmp180_words_are_read_big_endian_and_checked) {
    const uint8_t bytes[BMP180_WORDS_SIZE] = {0x01, 0x98, 0xFF, 0xB8, 0xC7, 0xD1, 0x7F, 0xE5,
                                              0x7F, 0xF5, 0x5A, 0x71, 0x18, 0x2E, 0x00, 0x04,
                                              0x80, 0x00, 0xDD, 0xF9, 0x0B, 0x34};
    Bmp180Words words = {};
    CHECK(bmp180_read_words(bytes, &words));
    CHECK(words.ac1 == 408 && words.ac2 == -72 && words.ac3 == -14383);
    CHECK(words.ac4 == 32741 && words.ac5 == 32757 && words.ac6 == 23153);
    CHECK(words.b1 == 6190 && words.b2 == 4 && words.mb == -32768 && words.mc == -8711);
    CHECK(words.md == 2868);
    for (int word = 0; word < BMP180_WORDS_SIZE / 2; ++word) {
        for (const int dead : {0x00, 0xFF}) {
            uint8_t broken[BMP180_WORDS_SIZE];
            for (int i = 0; i < BMP180_WORDS_SIZE; ++i) {
                broken[i] = static_cast<uint8_t>(i / 2 == word ? dead : bytes[i]);
            }
            CHECK(!bmp180_read_words(broken, &words));
        }
    }
}

TEST(bmp180_with_impossible_words_does_not_divide_by_zero) {
    Bmp180Words words = EXAMPLE;
    words.ac6 = 27898;
    words.md = 0;
    CHECK(bmp180_b5(&words, 27898) == 0);
}

TEST(mpu6050_factory_trim_follows_the_register_map) {
    CHECK(mpu6050_accel_trim(0) == 0 && mpu6050_gyro_trim(0) == 0);
    for (int code = 1; code < 32; ++code) {
        const double accel = 4096 * 0.34 * std::pow(0.92 / 0.34, (code - 1) / 30.0);
        const double gyro = 25 * 131 * std::pow(1.046, code - 1);
        CHECK_NEAR(mpu6050_accel_trim(static_cast<uint8_t>(code)), accel, accel * 0.001 + 1);
        CHECK_NEAR(mpu6050_gyro_trim(static_cast<uint8_t>(code)), gyro, gyro * 0.001 + 1);
    }
}

TEST(mpu6050_trim_codes_are_unpacked) {
    const uint8_t registers[4] = {0xE1, 0x42, 0x1F, 0x39};
    Mpu6050TrimCodes codes = {};
    mpu6050_trim_codes(registers, &codes);
    CHECK(codes.accel[0] == (7 << 2 | 3) && codes.gyro[0] == 1);
    CHECK(codes.accel[1] == (2 << 2 | 2) && codes.gyro[1] == 2);
    CHECK(codes.accel[2] == (0 << 2 | 1) && codes.gyro[2] == 31);
}

TEST(mpu6050_response_may_differ_by_14_percent) {
    CHECK(mpu6050_response_ok(1140, 1000) && mpu6050_response_ok(860, 1000));
    CHECK(!mpu6050_response_ok(1141, 1000) && !mpu6050_response_ok(859, 1000));
    CHECK(!mpu6050_response_ok(-1000, 1000) && !mpu6050_response_ok(0, 1000));
    CHECK(mpu6050_response_ok(5, 0));
}
