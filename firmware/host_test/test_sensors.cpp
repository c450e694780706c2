// SPDX-License-Identifier: Apache-2.0
// Compensation and self-test formulas against the datasheets.
#include <cmath>
#include <cstdint>

#include "common/bmp180_math.h"
#include "common/imu_chip.h"
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

// Registers of codes 14, 17, 20 for the accelerometer and 1, 2, 31 for the gyroscope.
constexpr uint8_t MPU6050_CODES[4] = {14 >> 2 << 5 | 1, 17 >> 2 << 5 | 2, 20 >> 2 << 5 | 31,
                                      (14 & 3) << 4 | (17 & 3) << 2 | (20 & 3)};
constexpr uint8_t NO_CODES[3] = {0, 0, 0};

TEST(mpu6050_expected_responses_follow_the_register_map) {
    uint16_t expected[IMU_AXES];
    imu_expected_responses(IMU_MPU6050, MPU6050_CODES, NO_CODES, expected);
    const int accel_codes[3] = {14, 17, 20};
    const int gyro_codes[3] = {1, 2, 31};
    for (int axis = 0; axis < 3; ++axis) {
        const double accel = 4096 * 0.34 * std::pow(0.92 / 0.34, (accel_codes[axis] - 1) / 30.0);
        const double gyro = 25 * 131 * std::pow(1.046, gyro_codes[axis] - 1);
        CHECK_NEAR(expected[axis], accel, accel * 0.001 + 1);
        CHECK_NEAR(expected[3 + axis], gyro, gyro * 0.001 + 1);
    }
}

TEST(later_chips_expected_responses_follow_their_register_map) {
    for (int code = 1; code < 256; ++code) {
        const uint8_t byte = static_cast<uint8_t>(code);
        const uint8_t accel[4] = {byte, byte, 0, 0};
        const uint8_t gyro[3] = {byte, byte, 0};
        const double response = 2620 * std::pow(1.01, code - 1);
        for (const ImuFamily family : {IMU_MPU6500, IMU_ICM20689}) {
            uint16_t expected[IMU_AXES];
            imu_expected_responses(family, accel, gyro, expected);
            CHECK_NEAR(expected[1], response, response * 0.004 + 1);
            CHECK_NEAR(expected[3], response, response * 0.004 + 1);
            CHECK(expected[2] == 0 && expected[5] == 0);
        }
    }
}

TEST(imu_response_tolerance_depends_on_the_family) {
    CHECK(imu_response_ok(IMU_MPU6050, 1140, 1000) && imu_response_ok(IMU_MPU6050, -860, 1000));
    CHECK(!imu_response_ok(IMU_MPU6050, 1141, 1000) && !imu_response_ok(IMU_MPU6050, 859, 1000));
    CHECK(imu_response_ok(IMU_MPU6500, 500, 1000) && imu_response_ok(IMU_ICM20689, -1500, 1000));
    CHECK(!imu_response_ok(IMU_MPU6500, 499, 1000) && !imu_response_ok(IMU_ICM20689, 0, 1000));
    CHECK(imu_response_ok(IMU_MPU6050, 5, 0) && imu_response_ok(IMU_UNKNOWN, 0, 1000));
}

TEST(imu_temperature_is_sent_on_the_mpu6050s_scale) {
    CHECK(imu_temperature(IMU_MPU6050, -3920) == -3920);
    for (int degc = -40; degc <= 85; ++degc) {
        const double counts = (degc - 36.53) * 340;
        const int16_t mpu6500 = static_cast<int16_t>(std::lround((degc - 21) * 333.87));
        const int16_t icm20689 = static_cast<int16_t>(std::lround((degc - 25) * 326.8));
        CHECK_NEAR(imu_temperature(IMU_MPU6500, mpu6500), counts, 4);
        CHECK_NEAR(imu_temperature(IMU_ICM20689, icm20689), counts, 4);
    }
    CHECK(imu_temperature(IMU_ICM20689, INT16_MIN) == INT16_MIN);
}

TEST(imu_families_are_known_by_their_ids) {
    CHECK(imu_family(0x68) == IMU_MPU6050 && imu_family(0x70) == IMU_MPU6500);
    CHECK(imu_family(0x71) == IMU_MPU6500 && imu_family(0x73) == IMU_MPU6500);
    CHECK(imu_family(0x98) == IMU_ICM20689 && imu_family(0x12) == IMU_ICM20689);
    CHECK(imu_family(0x19) == IMU_ICM20689);
    CHECK(imu_family(0x72) == IMU_UNKNOWN && imu_family(0x00) == IMU_UNKNOWN);
}
