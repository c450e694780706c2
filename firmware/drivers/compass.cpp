// SPDX-License-Identifier: Apache-2.0
#include "drivers/compass.h"

#include "hal/twi.h"

namespace {

constexpr uint8_t HMC5883L_IDENTIFICATION = 0x0A;
constexpr uint8_t QMC5883L_CONTROL_1 = 0x09;
constexpr uint8_t QMC5883L_SET_RESET_PERIOD = 0x0B;
constexpr uint8_t QMC5883L_ID = 0x0D;
constexpr uint8_t QMC5883L_ID_VALUE = 0xFF;
constexpr uint8_t QMC5883P_ID = 0x00;
constexpr uint8_t QMC5883P_ID_VALUE = 0x80;
constexpr uint8_t QMC5883P_CONTROL = 0x0A;
constexpr uint8_t QMC5883P_AXIS_SIGNS = 0x29;
constexpr uint8_t QMC5883P_AXIS_SIGNS_VALUE = 0x06;  // the datasheet's set-up example, section 7.1

bool write_register(uint8_t address, uint8_t at, uint8_t value) {
    const uint8_t bytes[2] = {at, value};
    return twi_run(address, bytes, sizeof bytes, nullptr, 0);
}

bool read_registers(uint8_t address, uint8_t from, uint8_t *bytes, uint8_t size) {
    return twi_run(address, &from, 1, bytes, size);
}

bool set_up_hmc5883l() {
    uint8_t id[3];
    // The address pointer goes on by itself: configuration A and B, then the mode.
    const uint8_t set[4] = {0x00, HMC5883L_CONFIG_A, HMC5883L_CONFIG_B, HMC5883L_CONTINUOUS};
    return read_registers(HMC5883L_ADDRESS, HMC5883L_IDENTIFICATION, id, sizeof id) &&
           id[0] == 'H' && id[1] == '4' && id[2] == '3' &&
           twi_run(HMC5883L_ADDRESS, set, sizeof set, nullptr, 0);
}

bool set_up_qmc5883l() {
    uint8_t id = 0;
    uint8_t data;
    // The id is reliable only after a read of the data registers.
    return read_registers(QMC5883L_ADDRESS, 0x00, &data, 1) &&
           read_registers(QMC5883L_ADDRESS, QMC5883L_ID, &id, 1) && id == QMC5883L_ID_VALUE &&
           write_register(QMC5883L_ADDRESS, QMC5883L_SET_RESET_PERIOD, 0x01) &&
           write_register(QMC5883L_ADDRESS, QMC5883L_CONTROL_1, QMC5883L_CONTROL);
}

bool set_up_qmc5883p() {
    uint8_t id = 0;
    const uint8_t set[3] = {QMC5883P_CONTROL, QMC5883P_CONTROL_1, QMC5883P_CONTROL_2};
    return read_registers(QMC5883P_ADDRESS, QMC5883P_ID, &id, 1) && id == QMC5883P_ID_VALUE &&
           write_register(QMC5883P_ADDRESS, QMC5883P_AXIS_SIGNS, QMC5883P_AXIS_SIGNS_VALUE) &&
           twi_run(QMC5883P_ADDRESS, set, sizeof set, nullptr, 0);
}

}  // namespace

const CompassChip *compass_set_up() {
    bool (*const set_up[COMPASS_CHIPS])() = {set_up_hmc5883l, set_up_qmc5883l, set_up_qmc5883p};
    for (uint8_t i = 0; i < COMPASS_CHIPS; ++i) {
        if (twi_answers(COMPASS_CHIP[i].address) && set_up[i]()) {
            return &COMPASS_CHIP[i];
        }
    }
    return nullptr;
}
