// SPDX-License-Identifier: Apache-2.0
#include "drivers/gps.h"

#include <string.h>

#include "hal/clock.h"
#include "hal/stored_settings.h"
#include "hal/uart.h"
#include "settings.h"

namespace {

enum State : uint8_t { SEARCH, PORT, CONFIGURE, RUNNING };

// Every speed that a receiver is sold with or may have stored. An 8 MHz board makes 250000 baud
// instead of 230400: it finds up to 115200.
//
// Listening goes from GPS_BAUD upwards and then on from the slowest: at a high speed little of a burst
// is lost until framing errors show that it is wrong. Sending without having heard anything goes from
// the highest downwards: what is sent too slowly gives a receiver framing errors by the dozen, and a
// u-blox that counts 100 in a second stops listening for the rest of it.
constexpr uint32_t SPEEDS[] = {230400, 115200, 57600, 38400, 19200, 9600, 4800};
constexpr uint8_t SPEED_COUNT = sizeof SPEEDS / sizeof SPEEDS[0];

constexpr uint8_t index_of(uint32_t baud) {
    uint8_t index = 0;
    while (index < SPEED_COUNT - 1 && SPEEDS[index] > baud) {
        ++index;
    }
    return index;
}
constexpr uint8_t GPS_SPEED = index_of(GPS_BAUD);
static_assert(SPEEDS[GPS_SPEED] == GPS_BAUD, "GPS_BAUD is a speed of GPS receivers");

// At the right speed a receiver that is heard in the middle of a byte falls in step within a few.
constexpr uint8_t WRONG_SPEED_ERRORS = 4;
// Receivers send at least once a second, and some start no faster than the board.
constexpr uint32_t QUIET_US = 1300000;
// A receiver answers within some 50 ms; one that computes a solution takes longer.
constexpr uint32_t ANSWER_US = 250000;
// Between two settings for a receiver that acknowledges nothing, and after the last one until it must
// have been heard: it then sends five solutions a second.
constexpr uint32_t SPACING_US = 60000;
constexpr uint32_t HEARD_US = 500000;
// After its port's speed changed it answers at once; the pause lets its last old byte pass.
constexpr uint32_t SETTLE_US = 40000;
// Without a solution: of UBX, of NMEA at 1 Hz, and right after the set-up.
constexpr uint32_t SILENT_UBX_US = 1500000;
constexpr uint32_t SILENT_US = 3000000;
constexpr uint8_t SILENT_ERRORS = 12;
// A receiver that is heard is spoken to behind its burst: it would answer behind it, too.
constexpr uint32_t BURST_END_US = 30000;
// A message comes in one piece; ten a second leave 74 ms between them at 57600 baud.
constexpr uint32_t CUT_US = 50000;

constexpr uint8_t byte_of(uint32_t value, uint8_t shift) { return static_cast<uint8_t>(value >> shift); }

// --- The settings ---------------------------------------------------------------------------------

// u-blox 8 / M8 receiver description, sections 32.10.25.5, .20.2, .27.1 and .19.1.
constexpr uint8_t CFG_PORT[20] = {
    1, 0, 0, 0,        // UART 1, no ready line
    0xD0, 0x08, 0, 0,  // 8N1
    byte_of(GPS_BAUD, 0), byte_of(GPS_BAUD, 8), byte_of(GPS_BAUD, 16), byte_of(GPS_BAUD, 24),
    0x01, 0, 0x01, 0,  // UBX in, UBX out
    0, 0, 0, 0,
};

// UBX-CFG-VALSET, u-blox M10 interface description: version 0, layer RAM, then keys and values.
constexpr uint8_t VALSET_PORT[12] = {
    0, 0x01, 0, 0,
    0x01, 0x00, 0x52, 0x40,  // CFG-UART1-BAUDRATE
    byte_of(GPS_BAUD, 0), byte_of(GPS_BAUD, 8), byte_of(GPS_BAUD, 16), byte_of(GPS_BAUD, 24),
};
constexpr uint8_t VALSET_SIZE = 25;
constexpr uint8_t NAV5_SIZE = 36;
constexpr uint8_t LONGEST_SETTING = NAV5_SIZE;

// Room for both settings of the port, or for both of the first settings.
uint8_t tx_ring[80];

void start_uart(Gps *gps, uint32_t baud) {
    uart_start(baud, tx_ring, sizeof tx_ring);
    gps->heard = false;
    gps->errors_before = uart_errors();
    gps->baud_hundreds = static_cast<uint16_t>(baud / 100);
}

void send(uint16_t id, const uint8_t *payload, uint8_t size) {
    uint8_t bytes[LONGEST_SETTING + UBX_OVERHEAD];
    uart_write(bytes, ubx_write(id, payload, size, bytes));
}

uint16_t period_ms() { return static_cast<uint16_t>(1000U / stored_settings().gps_rate_hz); }

void send_port() {
    send(UBX_CFG_PRT, CFG_PORT, sizeof CFG_PORT);
    send(UBX_CFG_VALSET, VALSET_PORT, sizeof VALSET_PORT);
}

void send_valset() {
    const uint16_t period = period_ms();
    const uint8_t payload[VALSET_SIZE] = {
        0, 0x01, 0, 0,
        0x01, 0x00, 0x21, 0x30, byte_of(period, 0), byte_of(period, 8),  // CFG-RATE-MEAS
        0x07, 0x00, 0x91, 0x20, 1,                                       // NAV-PVT on UART 1
        0x02, 0x00, 0x74, 0x10, 0,                                       // no NMEA on UART 1
        0x21, 0x00, 0x11, 0x20, stored_settings().gps_dynamic_model,     // CFG-NAVSPG-DYNMODEL
    };
    send(UBX_CFG_VALSET, payload, sizeof payload);
}

void send_message_rate(uint16_t id) {
    const uint8_t payload[3] = {byte_of(id, 8), byte_of(id, 0), 1};  // with every solution
    send(UBX_CFG_MSG, payload, sizeof payload);
}

void send_rate() {
    const uint16_t period = period_ms();
    const uint8_t payload[6] = {byte_of(period, 0), byte_of(period, 8), 1, 0, 1, 0};
    send(UBX_CFG_RATE, payload, sizeof payload);
}

void send_model() {
    // Apply the dynamic model alone.
    const uint8_t payload[NAV5_SIZE] = {0x01, 0, stored_settings().gps_dynamic_model};
    send(UBX_CFG_NAV5, payload, sizeof payload);
}

// --- States ---------------------------------------------------------------------------------------

enum Step : uint8_t { FIRST, PROTOCOL, RATE, MODEL, POSLLH, SOL, VELNED, TIMEUTC, WAIT };

// What the first settings were answered with.
enum Answer : uint8_t { VALSET_ACK = 1, VALSET_NAK = 2, MESSAGE_ACK = 4, MESSAGE_NAK = 8 };

void go_to(Gps *gps, uint8_t state) {
    gps->state = state;
    gps->step = FIRST;
    gps->sent = false;
    gps->since_us = clock_us();
}

void listen(Gps *gps, uint8_t speed) {
    gps->speed = speed;
    gps->found = false;
    start_uart(gps, SPEEDS[speed]);
    go_to(gps, SEARCH);
}

// Without having heard anything: at this speed, then at the next lower one.
void probe(Gps *gps, uint8_t speed) {
    gps->speed = speed;
    start_uart(gps, SPEEDS[speed]);
    go_to(gps, PORT);
}

void search_again(Gps *gps) {
    ++gps->failures;
    gps->solving = false;
    gps->module = WIRE_GPS_UNKNOWN;
    gps->acknowledged = false;
    listen(gps, GPS_SPEED);
}

bool too_many_errors(const Gps *gps, uint8_t limit) {
    return static_cast<uint16_t>(uart_errors() - gps->errors_before) >= limit;
}

void poll_search(Gps *gps, uint32_t now_us) {
    if (gps->heard) {
        gps->found = true;
        go_to(gps, PORT);
    } else if (too_many_errors(gps, WRONG_SPEED_ERRORS)) {
        listen(gps, static_cast<uint8_t>((gps->speed + SPEED_COUNT - 1) % SPEED_COUNT));
    } else if (clock_passed(now_us, gps->since_us + QUIET_US)) {
        probe(gps, 0);
    }
}

void poll_port(Gps *gps, uint32_t now_us) {
    if (!gps->sent) {
        const bool in_burst = !clock_passed(now_us, gps->byte_us + BURST_END_US);
        if (gps->found && in_burst && !clock_passed(now_us, gps->since_us + QUIET_US)) {
            return;
        }
        send_port();
        gps->sent = true;
    }
    if (uart_writing()) {
        gps->since_us = now_us;
    } else if (clock_passed(now_us, gps->since_us + SETTLE_US)) {
        start_uart(gps, GPS_BAUD);
        gps->answers = 0;
        go_to(gps, CONFIGURE);
    }
}

void send_step(Gps *gps) {
    switch (gps->step) {
        case FIRST:
            send_valset();
            send_message_rate(UBX_NAV_PVT);
            break;
        case PROTOCOL:
            // Again: a receiver that was at GPS_BAUD already may have missed it among other speeds.
            send(UBX_CFG_PRT, CFG_PORT, sizeof CFG_PORT);
            break;
        case RATE:
            send_rate();
            break;
        case MODEL:
            send_model();
            break;
        case POSLLH:
            send_message_rate(UBX_NAV_POSLLH);
            break;
        case SOL:
            send_message_rate(UBX_NAV_SOL);
            break;
        case VELNED:
            send_message_rate(UBX_NAV_VELNED);
            break;
        case TIMEUTC:
            send_message_rate(UBX_NAV_TIMEUTC);
            break;
        default:
            break;
    }
    gps->sent = true;
    gps->since_us = clock_us();
}

void run(Gps *gps) {
    const uint8_t nothing = 0;
    send(UBX_MON_VER, &nothing, 0);
    gps->errors_before = uart_errors();
    gps->ubx = false;
    go_to(gps, RUNNING);
}

// All of them for a receiver that acknowledges nothing; POSLLH and the following for a u-blox 6.
void next_step(Gps *gps) {
    const bool old = (gps->answers & MESSAGE_ACK) == 0;
    ++gps->step;
    gps->sent = false;
    if (gps->acknowledged && gps->step >= (old ? WAIT : POSLLH)) {
        run(gps);
    }
}

// The first settings have been answered, or will not be.
void end_first(Gps *gps, uint32_t now_us) {
    const bool waited = clock_passed(now_us, gps->since_us + ANSWER_US);
    if ((gps->answers & VALSET_ACK) != 0) {
        gps->acknowledged = true;
        run(gps);
    } else if ((gps->answers & (MESSAGE_ACK | MESSAGE_NAK)) != 0 &&
               (waited || (gps->answers & VALSET_NAK) != 0)) {
        gps->acknowledged = true;
        next_step(gps);
    } else if (waited && (gps->heard || gps->found || gps->speed + 1 == SPEED_COUNT)) {
        next_step(gps);
    } else if (waited && too_many_errors(gps, WRONG_SPEED_ERRORS)) {
        listen(gps, GPS_SPEED);
    } else if (waited) {
        probe(gps, static_cast<uint8_t>(gps->speed + 1));
    }
}

// Every setting has been sent and none acknowledged: the receiver has followed, or goes on as before.
void end_wait(Gps *gps, uint32_t now_us) {
    if (gps->heard) {
        run(gps);
    } else if (clock_passed(now_us, gps->since_us + HEARD_US)) {
        start_uart(gps, SPEEDS[gps->speed]);
        if (gps->found) {
            run(gps);
        } else {
            listen(gps, GPS_SPEED);
        }
    }
}

void poll_configure(Gps *gps, uint32_t now_us) {
    if (!gps->sent) {
        send_step(gps);
    } else if (gps->step == FIRST) {
        end_first(gps, now_us);
    } else if (gps->step == WAIT) {
        end_wait(gps, now_us);
    } else if (clock_passed(now_us, gps->since_us + (gps->acknowledged ? ANSWER_US : SPACING_US))) {
        next_step(gps);
    }
}

void poll_running(Gps *gps, uint32_t now_us) {
    const uint32_t silent_us = gps->ubx ? SILENT_UBX_US : SILENT_US;
    if (clock_passed(now_us, gps->since_us + silent_us) || too_many_errors(gps, SILENT_ERRORS)) {
        search_again(gps);
    }
}

void count_errors(Gps *gps) {
    const uint16_t seen = static_cast<uint16_t>(uart_errors() + gps->reader.errors + gps->nmea.errors);
    if (gps->state == RUNNING) {
        gps->errors = static_cast<uint16_t>(gps->errors + (seen - gps->errors_seen));
    }
    gps->errors_seen = seen;
}

// --- What comes in --------------------------------------------------------------------------------

void take_answer(Gps *gps, bool ack, uint16_t about) {
    if (gps->state != CONFIGURE || !gps->sent) {
        return;
    }
    if (gps->step != FIRST) {
        // A refused setting is counted and left: a fix at another rate is better than none.
        gps->failures = static_cast<uint16_t>(gps->failures + (ack ? 0 : 1));
        next_step(gps);
    } else if (about == UBX_CFG_VALSET) {
        gps->answers |= ack ? VALSET_ACK : VALSET_NAK;
    } else if (about == UBX_CFG_MSG) {
        gps->answers |= ack ? MESSAGE_ACK : MESSAGE_NAK;
    }
}

bool end_solution(Gps *gps, bool ubx, uint32_t began_us) {
    gps->ubx = ubx;
    gps->seen = true;
    gps->solution_us = began_us;
    gps->errors_before = uart_errors();
    if (gps->state == RUNNING) {
        gps->solving = true;
        gps->since_us = clock_us();
    }
    return true;
}

void take_version(Gps *gps) {
    const uint8_t generation = ubx_generation(&gps->reader);
    if (generation != 0) {
        gps->module = generation;
    }
}

// True if the message completes a solution.
bool take_message(Gps *gps) {
    const UbxReader *reader = &gps->reader;
    gps->heard = true;
    if (gps->module < WIRE_GPS_UBX_6) {
        gps->module = WIRE_GPS_UBX;
    }
    switch (reader->id) {
        case UBX_NAV_PVT:
            if (reader->size != UBX_NAV_PVT_SIZE) {
                return false;
            }
            ubx_to_fix(reader->payload, &gps->fix);
            ubx_to_quality(reader->payload, &gps->quality);
            gps->parts.have = 0;
            return end_solution(gps, true, gps->message_us);
        case UBX_ACK_ACK:
        case UBX_ACK_NAK:
            if (reader->size == 2) {
                take_answer(gps, reader->id == UBX_ACK_ACK, ubx_id(reader->payload[0], reader->payload[1]));
            }
            return false;
        case UBX_MON_VER:
            take_version(gps);
            return false;
        default:
            return ubx_take_part(&gps->parts, reader, gps->message_us, &gps->fix, &gps->quality) &&
                   end_solution(gps, true, gps->parts.begun_us);
    }
}

// Sentences count only where no UBX solutions come: before the set-up is through they belong to the
// settings that it replaces.
bool take_sentence(Gps *gps) {
    gps->heard = true;
    if (gps->module == WIRE_GPS_UNKNOWN) {
        gps->module = WIRE_GPS_NMEA;
    }
    return gps->state == RUNNING && !gps->ubx &&
           nmea_join(&gps->epoch, &gps->nmea, gps->sentence_us, &gps->fix, &gps->quality) &&
           end_solution(gps, false, gps->epoch.begun_us);
}

bool take_byte(Gps *gps, uint8_t byte) {
    const uint32_t now_us = clock_us();
    if (clock_passed(now_us, gps->byte_us + CUT_US)) {
        ubx_cut(&gps->reader);
    }
    gps->byte_us = now_us;
    const bool message = ubx_read(&gps->reader, byte);
    const bool sentence = nmea_read(&gps->nmea, byte);
    if (ubx_begun(&gps->reader)) {
        gps->message_us = now_us;
    }
    if (nmea_begun(&gps->nmea)) {
        gps->sentence_us = now_us;
    }
    return (message && take_message(gps)) || (sentence && take_sentence(gps));
}

}  // namespace

void gps_start(Gps *gps) {
    memset(gps, 0, sizeof *gps);
    nmea_start(&gps->nmea, &gps->epoch);
    listen(gps, GPS_SPEED);
}

bool gps_poll(Gps *gps) {
    bool solution = false;
    uint8_t byte;
    while (!solution && uart_read(&byte)) {
        solution = take_byte(gps, byte);
    }
    count_errors(gps);
    const uint32_t now_us = clock_us();
    switch (gps->state) {
        case SEARCH:
            poll_search(gps, now_us);
            break;
        case PORT:
            poll_port(gps, now_us);
            break;
        case CONFIGURE:
            poll_configure(gps, now_us);
            break;
        default:
            poll_running(gps, now_us);
            break;
    }
    return solution;
}

bool gps_running(const Gps *gps) { return gps->solving; }

WireChips gps_chips(const Gps *gps) {
    WireChips chips = {};
    if (gps->state == RUNNING) {
        chips.gps = static_cast<uint8_t>(gps->module | (gps->acknowledged ? WIRE_GPS_ACKNOWLEDGES : 0));
        chips.gps_baud = gps->baud_hundreds;
    }
    return chips;
}

uint16_t gps_errors(const Gps *gps) {
    return static_cast<uint16_t>(gps->errors + gps->failures);
}
