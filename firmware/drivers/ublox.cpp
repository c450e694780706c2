// SPDX-License-Identifier: Apache-2.0
#include "drivers/ublox.h"

#include <string.h>

#include "hal/clock.h"
#include "hal/stored_settings.h"
#include "hal/uart.h"
#include "settings.h"

namespace {

constexpr uint32_t FACTORY_BAUD = 9600;
constexpr uint32_t ANSWER_US = 300000;
// After its port's speed changed the M8N answers at once; the pause lets its last old byte pass.
constexpr uint32_t SETTLE_US = 50000;
constexpr uint32_t SILENT_US = 1500000;
// A message comes in one piece; ten a second leave 74 ms between them at the lowest speed.
constexpr uint32_t CUT_US = 50000;

enum Step : uint8_t { SET_PORT, SET_MESSAGE, SET_RATE, SET_MODEL, RUNNING };

constexpr uint8_t low(uint32_t value, uint8_t shift) { return static_cast<uint8_t>(value >> shift); }

// u-blox 8 / M8 receiver description, sections 32.10.25.5, .20.2, .27.1 and .19.1.
constexpr uint8_t PORT[20] = {
    1, 0, 0, 0,              // UART 1, no ready line
    0xD0, 0x08, 0, 0,        // 8N1
    low(GPS_BAUD, 0), low(GPS_BAUD, 8), low(GPS_BAUD, 16), low(GPS_BAUD, 24),
    0x01, 0, 0x01, 0,        // UBX in, UBX out
    0, 0, 0, 0,
};
constexpr uint8_t MESSAGE[3] = {0x01, 0x07, 1};  // NAV-PVT with every solution
uint8_t rate[6] = {0, 0, 1, 0, 1, 0};  // period in ms, filled in by ublox_start
uint8_t model[36] = {0x01, 0, 0};      // apply the dynamic model alone, filled in by ublox_start

struct Setting {
    uint16_t id;
    const uint8_t *payload;
    uint8_t size;
};

constexpr Setting SETTINGS[RUNNING] = {
    {UBX_CFG_PRT, PORT, sizeof PORT},
    {UBX_CFG_MSG, MESSAGE, sizeof MESSAGE},
    {UBX_CFG_RATE, rate, sizeof rate},
    {UBX_CFG_NAV5, model, sizeof model},
};
constexpr uint8_t LONGEST_SETTING = sizeof model;

uint8_t tx_ring[LONGEST_SETTING + UBX_OVERHEAD + 1];

void start_uart(uint32_t baud) { uart_start(baud, tx_ring, sizeof tx_ring); }

void send_setting(Ublox *ublox) {
    const Setting &setting = SETTINGS[ublox->step];
    uint8_t bytes[LONGEST_SETTING + UBX_OVERHEAD];
    uart_write(bytes, ubx_write(setting.id, setting.payload, setting.size, bytes));
    ublox->sent = true;
    ublox->since_us = clock_us();
}

void go_to(Ublox *ublox, uint8_t step) {
    ublox->step = step;
    ublox->sent = false;
    ublox->since_us = clock_us();
}

void try_speed(Ublox *ublox, bool factory) {
    ublox->at_factory_speed = factory;
    start_uart(factory ? FACTORY_BAUD : GPS_BAUD);
    go_to(ublox, SET_PORT);
}

void configure(Ublox *ublox) {
    const uint32_t now_us = clock_us();
    if (!ublox->sent) {
        send_setting(ublox);
    } else if (ublox->step == SET_PORT) {
        if (!uart_writing() && clock_passed(now_us, ublox->since_us + SETTLE_US)) {
            start_uart(GPS_BAUD);
            go_to(ublox, SET_MESSAGE);
        }
    } else if (clock_passed(now_us, ublox->since_us + ANSWER_US)) {
        ++ublox->failures;
        try_speed(ublox, !ublox->at_factory_speed);
    }
}

// True if the message is a solution that the caller wants.
bool take_message(Ublox *ublox) {
    const UbxReader *reader = &ublox->reader;
    if (reader->id == UBX_NAV_PVT && reader->size == UBX_NAV_PVT_SIZE) {
        ublox->seen = true;
        if (ublox->step == RUNNING) {
            ublox->since_us = clock_us();
        }
        return true;
    }
    if (ublox->step == RUNNING || ublox->step == SET_PORT || reader->size != 2) {
        return false;
    }
    const uint16_t about = ubx_id(reader->payload[0], reader->payload[1]);
    if (about == SETTINGS[ublox->step].id) {
        // A refused setting is counted and left: a fix at another rate is better than none.
        ublox->failures = static_cast<uint16_t>(ublox->failures + (reader->id == UBX_ACK_NAK ? 1 : 0));
        go_to(ublox, static_cast<uint8_t>(ublox->step + 1));
    }
    return false;
}

}  // namespace

void ublox_start(Ublox *ublox) {
    memset(ublox, 0, sizeof *ublox);
    const uint16_t period_ms = static_cast<uint16_t>(1000U / stored_settings().gps_rate_hz);
    rate[0] = low(period_ms, 0);
    rate[1] = low(period_ms, 8);
    model[2] = stored_settings().gps_dynamic_model;
    try_speed(ublox, false);
}

bool ublox_poll(Ublox *ublox) {
    bool solution = false;
    uint8_t byte;
    while (!solution && uart_read(&byte)) {
        const uint32_t now_us = clock_us();
        if (clock_passed(now_us, ublox->byte_us + CUT_US)) {
            ubx_cut(&ublox->reader);
        }
        ublox->byte_us = now_us;
        const bool complete = ubx_read(&ublox->reader, byte);
        if (ubx_begun(&ublox->reader)) {
            ublox->message_us = now_us;
        }
        solution = complete && take_message(ublox);
    }
    if (ublox->step != RUNNING) {
        configure(ublox);
    } else if (clock_passed(clock_us(), ublox->since_us + SILENT_US)) {
        try_speed(ublox, false);
    }
    return solution;
}

bool ublox_running(const Ublox *ublox) { return ublox->step == RUNNING; }
