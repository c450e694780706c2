// SPDX-License-Identifier: Apache-2.0
// Compensation and self-test formulas against the datasheets.
#include <cmath>
#include <cstdint>

#include "common/bmp180_math.h"
#include "common/bmp280_math.h"
#include "common/compass_chip.h"
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

// The example of the BMP280 datasheet, section 3.12.
constexpr Bmp280Words BMP280_EXAMPLE = {27504, 26435, -1000, 36477, -10685, 3024,
                                        2855,  140,   -7,    15500, -14600, 6000};

TEST(bmp280_gives_the_datasheets_example) {
    const int32_t t_fine = bmp280_t_fine(&BMP280_EXAMPLE, 519888);
    CHECK(t_fine == 128422);
    CHECK(bmp280_temperature_ddegc(t_fine) == 251);
    CHECK_NEAR(bmp280_pressure_centipa(&BMP280_EXAMPLE, t_fine, 415148), 10065327, 2);
}

TEST(bmp280_words_are_read_little_endian_and_checked) {
    uint8_t bytes[BMP280_WORDS_SIZE] = {0x70, 0x6B, 0x43, 0x67, 0x18, 0xFC, 0x7D, 0x8E};
    Bmp280Words words = {};
    CHECK(bmp280_read_words(bytes, &words));
    CHECK(words.t1 == 27504 && words.t2 == 26435 && words.t3 == -1000 && words.p1 == 36477);
    bytes[6] = bytes[7] = 0;
    CHECK(!bmp280_read_words(bytes, &words));
}

TEST(bmp280_skipped_measurements_are_no_readings) {
    uint32_t pressure = 0;
    uint32_t temperature = 0;
    const uint8_t good[6] = {0x65, 0x5A, 0xC0, 0x7E, 0xED, 0x00};
    CHECK(bmp280_read_raw(good, &pressure, &temperature));
    CHECK(pressure == 415148 && temperature == 519888);
    const uint8_t skipped[6] = {0x80, 0x00, 0x00, 0x7E, 0xED, 0x00};
    CHECK(!bmp280_read_raw(skipped, &pressure, &temperature));
    const uint8_t dead[6] = {};
    CHECK(!bmp280_read_raw(dead, &pressure, &temperature));
}

TEST(compass_chips_are_read_on_the_hmc5883ls_axes) {
    int16_t mag[3];
    // x = 1, z = -2, y = 3, high byte first.
    uint8_t hmc[9] = {HMC5883L_CONFIG_A, HMC5883L_CONFIG_B, 0, 0, 1, 0xFF, 0xFE, 0, 3};
    CHECK(compass_read_bytes(COMPASS_CHIP[0], hmc, mag));
    CHECK(mag[0] == 1 && mag[1] == 3 && mag[2] == -2);
    hmc[2] = 2;
    CHECK(!compass_read_bytes(COMPASS_CHIP[0], hmc, mag));
    // x = 1, y = 3, z = -2, low byte first.
    uint8_t qmc_l[10] = {1, 0, 3, 0, 0xFE, 0xFF, 0x01, 0, 0, QMC5883L_CONTROL};
    CHECK(compass_read_bytes(COMPASS_CHIP[1], qmc_l, mag));
    CHECK(mag[0] == 1 && mag[1] == 3 && mag[2] == -2);
    qmc_l[9] = 0;
    CHECK(!compass_read_bytes(COMPASS_CHIP[1], qmc_l, mag));
    // Own x = 1, y = 3, z = -2.
    uint8_t qmc_p[11] = {1, 0, 3, 0, 0xFE, 0xFF, 0, 0, 0x01, QMC5883P_CONTROL_1, QMC5883P_CONTROL_2};
    CHECK(compass_read_bytes(COMPASS_CHIP[2], qmc_p, mag));
    CHECK(mag[0] == -3 && mag[1] == -1 && mag[2] == 2);
    qmc_p[10] = 0;
    CHECK(!compass_read_bytes(COMPASS_CHIP[2], qmc_p, mag));
}

TEST(compass_overflow_is_marked_and_no_other_reading_looks_like_it) {
    int16_t mag[3];
    uint8_t qmc_l[10] = {0x00, 0xF0, 3, 0, 0, 0x80, 0x01, 0, 0, QMC5883L_CONTROL};
    CHECK(compass_read_bytes(COMPASS_CHIP[1], qmc_l, mag));
    CHECK(mag[0] == -4095 && mag[1] == 3 && mag[2] == INT16_MIN);
    qmc_l[6] = 0x02;
    CHECK(compass_read_bytes(COMPASS_CHIP[1], qmc_l, mag));
    CHECK(mag[0] == WIRE_MAG_OVERFLOW && mag[2] == WIRE_MAG_OVERFLOW);
    uint8_t qmc_p[11] = {0x00, 0x10, 0, 0x80, 1, 0, 0, 0, 0x01, QMC5883P_CONTROL_1, QMC5883P_CONTROL_2};
    CHECK(compass_read_bytes(COMPASS_CHIP[2], qmc_p, mag));
    CHECK(mag[0] == INT16_MAX && mag[1] == -4095 && mag[2] == -1);
    qmc_p[8] = 0x02;
    CHECK(compass_read_bytes(COMPASS_CHIP[2], qmc_p, mag));
    CHECK(mag[0] == WIRE_MAG_OVERFLOW && mag[1] == WIRE_MAG_OVERFLOW);
}
