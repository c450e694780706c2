// SPDX-License-Identifier: Apache-2.0
#include "common/compass_chip.h"

namespace {

constexpr uint8_t HMC5883L_MODE = 0x03;
constexpr uint8_t QMC_OVERFLOW = 1 << 1;  // in the status register of both

int16_t big_endian(const uint8_t *bytes) { return static_cast<int16_t>(bytes[0] << 8 | bytes[1]); }

int16_t little_endian(const uint8_t *bytes) { return static_cast<int16_t>(bytes[1] << 8 | bytes[0]); }

// A field that is just the mark's value is moved by one count.
int16_t unmarked(int16_t counts) {
    return counts == WIRE_MAG_OVERFLOW ? WIRE_MAG_OVERFLOW + 1 : counts;
}

int16_t negated(int16_t counts) {
    return counts == INT16_MIN ? INT16_MAX : static_cast<int16_t>(-counts);
}

bool read_hmc5883l(const uint8_t *bytes, int16_t mag[3]) {
    mag[0] = big_endian(bytes + 3);
    mag[2] = big_endian(bytes + 5);
    mag[1] = big_endian(bytes + 7);
    return bytes[0] == HMC5883L_CONFIG_A && bytes[1] == HMC5883L_CONFIG_B &&
           (bytes[2] & HMC5883L_MODE) == HMC5883L_CONTINUOUS;
}

// `overflow`: the chip does not say on which axis.
void read_qmc(const uint8_t *bytes, bool overflow, int16_t mag[3]) {
    for (uint8_t axis = 0; axis < 3; ++axis) {
        mag[axis] = overflow ? WIRE_MAG_OVERFLOW : little_endian(bytes + 2 * axis);
    }
}

bool read_qmc5883l(const uint8_t *bytes, int16_t mag[3]) {
    const bool overflow = (bytes[6] & QMC_OVERFLOW) != 0;
    read_qmc(bytes, overflow, mag);
    for (uint8_t axis = 0; axis < 3 && !overflow; ++axis) {
        mag[axis] = unmarked(mag[axis]);
    }
    return bytes[9] == QMC5883L_CONTROL;
}

bool read_qmc5883p(const uint8_t *bytes, int16_t mag[3]) {
    const bool overflow = (bytes[8] & QMC_OVERFLOW) != 0;
    int16_t own[3];
    read_qmc(bytes, overflow, own);
    if (overflow) {
        mag[0] = mag[1] = mag[2] = WIRE_MAG_OVERFLOW;
    } else {
        mag[0] = unmarked(negated(own[1]));
        mag[1] = unmarked(negated(own[0]));
        mag[2] = unmarked(negated(own[2]));
    }
    return bytes[9] == QMC5883P_CONTROL_1 && bytes[10] == QMC5883P_CONTROL_2;
}

}  // namespace

bool compass_read_bytes(const CompassChip &chip, const uint8_t *bytes, int16_t mag[3]) {
    switch (chip.address) {
        case HMC5883L_ADDRESS:
            return read_hmc5883l(bytes, mag);
        case QMC5883L_ADDRESS:
            return read_qmc5883l(bytes, mag);
        default:
            return read_qmc5883p(bytes, mag);
    }
}
