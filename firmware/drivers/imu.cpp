// SPDX-License-Identifier: Apache-2.0
#include "drivers/imu.h"

#include "common/imu_chip.h"
#include "common/imu_reducer.h"
#include "hal/board.h"
#include "hal/stored_settings.h"
#include "hal/twi.h"
#include "settings.h"

namespace {

constexpr uint8_t SMPLRT_DIV = 0x19;
constexpr uint8_t CONFIG = 0x1A;
constexpr uint8_t GYRO_CONFIG = 0x1B;
constexpr uint8_t ACCEL_CONFIG = 0x1C;
// The accelerometer's filter of the MPU6500 and later; an unused threshold in the MPU6050.
constexpr uint8_t ACCEL_CONFIG_2 = 0x1D;
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
// Butterworth, which must not be bent by it. The same codes hold in 0x1D, within some hertz.
constexpr uint8_t DLPF_44_HZ = 3;
constexpr uint8_t DLPF_184_HZ = 1;
constexpr uint8_t RATE_DIVISOR = 1000 / IMU_SAMPLE_HZ - 1;  // 1 kHz behind the low-pass

constexpr uint8_t TEST_GYRO_RANGE = 0;  // +-250 deg/s
constexpr uint8_t TEST_SETTLE_MS = 30;
constexpr uint8_t TEST_READINGS = 16;

bool write_register(uint8_t address, uint8_t value) {
    const uint8_t bytes[2] = {address, value};
    return twi_run(IMU_ADDRESS, bytes, sizeof bytes, nullptr, 0);
}

bool read_registers(uint8_t address, uint8_t *bytes, uint8_t size) {
    return twi_run(IMU_ADDRESS, &address, 1, bytes, size);
}

bool set_ranges(uint8_t accel, uint8_t gyro, uint8_t self_test) {
    return write_register(GYRO_CONFIG, static_cast<uint8_t>(gyro << RANGE_SHIFT | self_test)) &&
           write_register(ACCEL_CONFIG, static_cast<uint8_t>(accel << RANGE_SHIFT | self_test));
}

bool set_ranges() {
    return set_ranges(stored_settings().accel_range, stored_settings().gyro_range, 0);
}

// Whether the four registers from SMPLRT_DIV hold what was written.
bool kept(uint8_t dlpf) {
    uint8_t read[4] = {};
    return read_registers(SMPLRT_DIV, read, sizeof read) && read[0] == RATE_DIVISOR &&
           read[1] == dlpf && read[2] == stored_settings().gyro_range << RANGE_SHIFT &&
           read[3] == stored_settings().accel_range << RANGE_SHIFT;
}

// Sums of TEST_READINGS readings.
bool sum_readings(int32_t sums[IMU_AXES]) {
    for (uint8_t axis = 0; axis < IMU_AXES; ++axis) {
        sums[axis] = 0;
    }
    board_wait_ms(TEST_SETTLE_MS);
    for (uint8_t i = 0; i < TEST_READINGS; ++i) {
        uint8_t bytes[IMU_DATA_SIZE];
        ImuReading reading;
        if (!read_registers(IMU_DATA, bytes, sizeof bytes) || !imu_read_bytes(bytes, &reading)) {
            return false;
        }
        for (uint8_t axis = 0; axis < 3; ++axis) {
            sums[axis] += reading.accel[axis];
            sums[3 + axis] += reading.gyro[axis];
        }
        board_wait_ms(1);
    }
    return true;
}

}  // namespace

bool imu_reset() {
    if (!write_register(PWR_MGMT_1, DEVICE_RESET)) {
        return false;
    }
    board_wait_ms(100);
    return true;
}

bool imu_set_up(uint8_t *id) {
    const uint8_t dlpf = stored_settings().imu_raw != 0 ? DLPF_44_HZ : DLPF_184_HZ;
    // The bypass comes first: the compass behind it is reached even if the chip fails what follows.
    return read_registers(WHO_AM_I, id, 1) && write_register(PWR_MGMT_1, CLOCK_GYRO_X) &&
           write_register(USER_CTRL, 0) && write_register(INT_PIN_CFG, BYPASS) &&
           write_register(SMPLRT_DIV, RATE_DIVISOR) && write_register(CONFIG, dlpf) &&
           write_register(ACCEL_CONFIG_2, dlpf) && set_ranges() && kept(dlpf) &&
           write_register(INT_ENABLE, DATA_READY);
}

bool imu_self_test(uint8_t id) {
    const ImuFamily family = imu_family(id);
    const ImuSelfTest test = imu_self_test_of(family);
    uint8_t accel_codes[4];
    uint8_t gyro_codes[3];
    int32_t off[IMU_AXES];
    int32_t on[IMU_AXES];
    const bool measured = set_ranges(test.accel_range, TEST_GYRO_RANGE, 0) && sum_readings(off) &&
                          set_ranges(test.accel_range, TEST_GYRO_RANGE, SELF_TEST_ALL) &&
                          sum_readings(on) &&
                          read_registers(test.accel_codes, accel_codes, sizeof accel_codes) &&
                          read_registers(test.gyro_codes, gyro_codes, sizeof gyro_codes);
    if (!set_ranges() || !measured) {
        return false;
    }
    board_wait_ms(TEST_SETTLE_MS);  // the test's own deflection must not reach the first samples
    uint16_t expected[IMU_AXES];
    imu_expected_responses(family, accel_codes, gyro_codes, expected);
    bool ok = true;
    for (uint8_t axis = 0; axis < IMU_AXES; ++axis) {
        ok = ok && imu_response_ok(family, (on[axis] - off[axis]) / TEST_READINGS, expected[axis]);
    }
    return ok;
}
