// SPDX-License-Identifier: Apache-2.0
#include "common/mpu6050_math.h"

namespace {

constexpr uint8_t FRACTION_BITS = 4;
// 4096 counts/g * 0.34 g and 131 counts per deg/s * 25 deg/s, both for code 1.
constexpr uint32_t ACCEL_TRIM_CODE_1 = 22282;  // 1392.64 with 4 fraction bits
constexpr uint32_t GYRO_TRIM_CODE_1 = 52400;   // 3275
// What one code more multiplies the trim by: (0.92 / 0.34)^(1/30) and 1.046, over 2^15.
constexpr uint32_t ACCEL_STEP = 33874;
constexpr uint32_t GYRO_STEP = 34275;

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

}  // namespace

void mpu6050_trim_codes(const uint8_t *registers, Mpu6050TrimCodes *codes) {
    for (uint8_t axis = 0; axis < 3; ++axis) {
        const uint8_t low = static_cast<uint8_t>(registers[3] >> (4 - 2 * axis)) & 0x03;
        codes->accel[axis] = static_cast<uint8_t>((registers[axis] >> 5) << 2 | low);
        codes->gyro[axis] = registers[axis] & 0x1F;
    }
}

uint16_t mpu6050_accel_trim(uint8_t code) { return trim(code, ACCEL_TRIM_CODE_1, ACCEL_STEP); }

uint16_t mpu6050_gyro_trim(uint8_t code) { return trim(code, GYRO_TRIM_CODE_1, GYRO_STEP); }

bool mpu6050_response_ok(int32_t response, uint16_t trim) {
    if (trim == 0) {
        return true;
    }
    const int32_t deviation = response - static_cast<int32_t>(trim);
    const int32_t limit = static_cast<int32_t>(trim) * 14 / 100;
    return deviation <= limit && deviation >= -limit;
}
