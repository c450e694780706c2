// SPDX-License-Identifier: Apache-2.0
#include "drivers/hmc5883l.h"

#include "hal/twi.h"
#include "settings.h"

namespace {

constexpr uint8_t IDENTIFICATION = 0x0A;

constexpr uint8_t CONFIG_A = 3 << 5 | 6 << 2;  // the mean of 8, at 75 Hz
constexpr uint8_t CONFIG_B = MAG_GAIN << 5;
constexpr uint8_t CONTINUOUS = 0;
constexpr uint8_t MODE = 0x03;

int16_t word(const uint8_t *bytes) { return static_cast<int16_t>(bytes[0] << 8 | bytes[1]); }

}  // namespace

bool hmc5883l_set_up() {
    const uint8_t where = IDENTIFICATION;
    uint8_t id[3];
    if (!twi_run(HMC5883L_ADDRESS, &where, 1, id, sizeof id)) {
        return false;
    }
    // The address pointer goes on by itself: configuration A and B, then the mode.
    const uint8_t set[4] = {HMC5883L_FROM, CONFIG_A, CONFIG_B, CONTINUOUS};
    return id[0] == 'H' && id[1] == '4' && id[2] == '3' &&
           twi_run(HMC5883L_ADDRESS, set, sizeof set, nullptr, 0);
}

bool hmc5883l_read_bytes(const uint8_t *bytes, int16_t mag[3]) {
    if (bytes[0] != CONFIG_A || bytes[1] != CONFIG_B || (bytes[2] & MODE) != CONTINUOUS) {
        return false;
    }
    mag[0] = word(bytes + 3);
    mag[1] = word(bytes + 7);
    mag[2] = word(bytes + 5);
    return true;
}
