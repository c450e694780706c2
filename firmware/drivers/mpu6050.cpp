// SPDX-License-Identifier: Apache-2.0
#include "drivers/mpu6050.h"

#include "common/imu_reducer.h"
#include "common/mpu6050_math.h"
#include "hal/board.h"
#include "hal/stored_settings.h"
#include "hal/twi.h"
#include "settings.h"

namespace {

constexpr uint8_t SELF_TEST_X = 0x0D;
constexpr uint8_t SMPLRT_DIV = 0x19;
constexpr uint8_t CONFIG = 0x1A;
constexpr uint8_t GYRO_CONFIG = 0x1B;
constexpr uint8_t ACCEL_CONFIG = 0x1C;
constexpr uint8_t INT_PIN_CFG = 0x37;
constexpr uint8_t INT_ENABLE = 0x38;
constexpr uint8_t USER_CTRL = 0x6A;
constexpr uint8_t PWR_MGMT_1 = 0x6B;
constexpr uint8_t WHO_AM_I = 0x75;

constexpr uint8_t DEVICE_RESET = 1 << 7;
constexpr uint8_t CLOCK_GYRO_X = 1;  // steadier than the internal oscillator: section 4.30
constexpr uint8_t BYPASS = 1 << 1;
constexpr uint8_t DATA_READY = 1 << 0;
constexpr uint8_t SELF_TEST_ALL = 0xE0;
constexpr uint8_t RANGE_SHIFT = 3;

// The chip's own low-pass against aliasing: 44 Hz where nothing follows, 184 Hz before the node's
// Butterworth, which must not be bent by it.
constexpr uint8_t DLPF_44_HZ = 3;
constexpr uint8_t DLPF_184_HZ = 1;
constexpr uint8_t RATE_DIVISOR = 1000 / IMU_SAMPLE_HZ - 1;  // 1 kHz behind the low-pass

// Ranges at which the factory trims are given: +-8 g, +-250 deg/s.
constexpr uint8_t TEST_ACCEL_RANGE = 2;
constexpr uint8_t TEST_GYRO_RANGE = 0;
constexpr uint8_t TEST_SETTLE_MS = 30;
constexpr uint8_t TEST_READINGS = 16;

struct Sums {
    int32_t accel[3];
    int32_t gyro[3];
};

bool write_register(uint8_t address, uint8_t value) {
    const uint8_t bytes[2] = {address, value};
    return twi_run(MPU6050_ADDRESS, bytes, sizeof bytes, nullptr, 0);
}

bool read_registers(uint8_t address, uint8_t *bytes, uint8_t size) {
    return twi_run(MPU6050_ADDRESS, &address, 1, bytes, size);
}

bool set_ranges(uint8_t accel, uint8_t gyro, uint8_t self_test) {
    return write_register(GYRO_CONFIG, static_cast<uint8_t>(gyro << RANGE_SHIFT | self_test)) &&
           write_register(ACCEL_CONFIG, static_cast<uint8_t>(accel << RANGE_SHIFT | self_test));
}

bool set_ranges() {
    return set_ranges(stored_settings().accel_range, stored_settings().gyro_range, 0);
}

bool sum_readings(Sums *sums) {
    *sums = Sums{};
    board_wait_ms(TEST_SETTLE_MS);
    for (uint8_t i = 0; i < TEST_READINGS; ++i) {
        uint8_t bytes[MPU6050_DATA_SIZE];
        if (!read_registers(MPU6050_DATA, bytes, sizeof bytes)) {
            return false;
        }
        ImuReading reading;
        imu_read_bytes(bytes, &reading);
        for (uint8_t axis = 0; axis < 3; ++axis) {
            sums->accel[axis] += reading.accel[axis];
            sums->gyro[axis] += reading.gyro[axis];
        }
        board_wait_ms(1);
    }
    return true;
}

bool responses_ok(const Sums &rest, const Sums &test, const Mpu6050TrimCodes &codes) {
    bool ok = true;
    for (uint8_t axis = 0; axis < 3; ++axis) {
        const int32_t accel = (test.accel[axis] - rest.accel[axis]) / TEST_READINGS;
        const int32_t gyro = (test.gyro[axis] - rest.gyro[axis]) / TEST_READINGS;
        ok = ok && mpu6050_response_ok(accel, mpu6050_accel_trim(codes.accel[axis]));
        // The y axis of the gyroscope answers the other way: register map, section 4.1.
        ok = ok && mpu6050_response_ok(axis == 1 ? -gyro : gyro, mpu6050_gyro_trim(codes.gyro[axis]));
    }
    return ok;
}

}  // namespace

bool mpu6050_reset() {
    if (!write_register(PWR_MGMT_1, DEVICE_RESET)) {
        return false;
    }
    board_wait_ms(100);
    return true;
}

bool mpu6050_set_up() {
    uint8_t who = 0;
    const uint8_t dlpf = stored_settings().imu_raw != 0 ? DLPF_44_HZ : DLPF_184_HZ;
    return read_registers(WHO_AM_I, &who, 1) && who == MPU6050_ADDRESS &&
           write_register(PWR_MGMT_1, CLOCK_GYRO_X) && write_register(SMPLRT_DIV, RATE_DIVISOR) &&
           write_register(CONFIG, dlpf) && set_ranges() &&
           write_register(USER_CTRL, 0) && write_register(INT_PIN_CFG, BYPASS) &&
           write_register(INT_ENABLE, DATA_READY);
}

bool mpu6050_self_test() {
    uint8_t registers[4];
    Sums rest;
    Sums test;
    const bool measured = set_ranges(TEST_ACCEL_RANGE, TEST_GYRO_RANGE, 0) && sum_readings(&rest) &&
                          set_ranges(TEST_ACCEL_RANGE, TEST_GYRO_RANGE, SELF_TEST_ALL) &&
                          sum_readings(&test) &&
                          read_registers(SELF_TEST_X, registers, sizeof registers);
    if (!set_ranges() || !measured) {
        return false;
    }
    board_wait_ms(TEST_SETTLE_MS);  // the test's own deflection must not reach the first samples
    Mpu6050TrimCodes codes;
    mpu6050_trim_codes(registers, &codes);
    return responses_ok(rest, test, codes);
}
