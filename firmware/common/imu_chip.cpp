// SPDX-License-Identifier: Apache-2.0
#include "common/imu_chip.h"

namespace {

constexpr uint8_t FRACTION_BITS = 4;
// MPU6050: 4096 counts/g * 0.34 g and 131 counts per deg/s * 25 deg/s, both for code 1.
constexpr uint32_t ACCEL_TRIM_CODE_1 = 22282;  // 1392.64 with 4 fraction bits
constexpr uint32_t GYRO_TRIM_CODE_1 = 52400;   // 3275
// Factor from one code to the next: (0.92 / 0.34)^(1/30) and 1.046, over 2^15.
constexpr uint32_t ACCEL_STEP = 33874;
constexpr uint32_t GYRO_STEP = 34275;
// MPU6500 and later: 2620 counts for code 1 at +-2 g and +-250 deg/s, 1.01 from code to code.
constexpr uint32_t LATER_CODE_1 = 2620UL << FRACTION_BITS;
constexpr uint32_t LATER_STEP = 33096;

// Temperature scales, as the factor less 1 over 2^16 and the offset in counts of the MPU6050:
// 340 / 333.87 with 21 degC at 0, and 340 / 326.8 with 25 degC at 0.
constexpr int32_t MPU6500_FACTOR = 1203;
constexpr int32_t MPU6500_OFFSET = 5280;
constexpr int32_t ICM20689_FACTOR = 2647;
constexpr int32_t ICM20689_OFFSET = 3920;

uint16_t trim(uint8_t code, uint32_t first, uint32_t step) {
    if (code == 0) {
        return 0;
    }
    uint32_t value = first;
    for (uint8_t i = 1; i < code; ++i) {
        value = static_cast<uint32_t>((static_cast<uint64_t>(value) * step + 0x4000) >> 15);
    }
    return static_cast<uint16_t>(value >> FRACTION_BITS);
}

int16_t rescale(int16_t raw, int32_t factor, int32_t offset) {
    const int32_t counts = raw + ((raw * factor) >> 16) - offset;
    return static_cast<int16_t>(counts < INT16_MIN ? INT16_MIN : counts);
}

}  // namespace

ImuFamily imu_family(uint8_t id) {
    switch (id) {
        case 0x68:
            return IMU_MPU6050;
        case 0x70:
        case 0x71:
        case 0x73:
        case 0x74:
            return IMU_MPU6500;
        case 0x98:
        case 0x12:
        case 0x19:
        case 0xAF:
            return IMU_ICM20689;
        default:
            return IMU_UNKNOWN;
    }
}

int16_t imu_temperature(ImuFamily family, int16_t raw) {
    switch (family) {
        case IMU_MPU6500:
            return rescale(raw, MPU6500_FACTOR, MPU6500_OFFSET);
        case IMU_ICM20689:
            return rescale(raw, ICM20689_FACTOR, ICM20689_OFFSET);
        default:
            return raw;
    }
}

ImuSelfTest imu_self_test_of(ImuFamily family) {
    return family == IMU_MPU6050 ? ImuSelfTest{0x0D, 0x0D, 2} : ImuSelfTest{0x00, 0x0D, 0};
}

void imu_expected_responses(ImuFamily family, const uint8_t accel_codes[4],
                            const uint8_t gyro_codes[3], uint16_t expected[IMU_AXES]) {
    for (uint8_t axis = 0; axis < 3; ++axis) {
        if (family == IMU_MPU6050) {
            // Three high bits above the gyroscope's code, two low bits in the fourth register.
            const uint8_t low = static_cast<uint8_t>(accel_codes[3] >> (4 - 2 * axis)) & 0x03;
            const uint8_t code = static_cast<uint8_t>((accel_codes[axis] >> 5) << 2 | low);
            expected[axis] = trim(code, ACCEL_TRIM_CODE_1, ACCEL_STEP);
            expected[3 + axis] = trim(accel_codes[axis] & 0x1F, GYRO_TRIM_CODE_1, GYRO_STEP);
        } else {
            expected[axis] = trim(accel_codes[axis], LATER_CODE_1, LATER_STEP);
            expected[3 + axis] = trim(gyro_codes[axis], LATER_CODE_1, LATER_STEP);
        }
    }
}

bool imu_response_ok(ImuFamily family, int32_t response, uint16_t expected) {
    if (expected == 0 || family == IMU_UNKNOWN) {
        return true;
    }
    // The MPU6050 by RM-MPU-6000A, section 4.1: within 14 %. Later chips: half to one and a half.
    const int32_t tolerance = family == IMU_MPU6050 ? 14 : 50;
    const int32_t size = response < 0 ? -response : response;  // axes answer with either sign
    const int32_t deviation = size - static_cast<int32_t>(expected);
    const int32_t limit = static_cast<int32_t>(expected) * tolerance / 100;
    return deviation <= limit && deviation >= -limit;
}
