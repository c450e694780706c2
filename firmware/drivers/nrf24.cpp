// SPDX-License-Identifier: Apache-2.0
// nRF24L01+: Enhanced ShockBurst with dynamic payload length, 2-byte CRC and automatic
// acknowledgement. Product specification 1.0.
//
// Clones are used if they keep their configuration. None of what they do otherwise is used: the
// Si24R1 has the packet's NO_ACK bit reversed, which matters only with EN_DYN_ACK.
#include <string.h>

#include "drivers/radio.h"
#include "hal/board.h"
#include "hal/lines.h"
#include "hal/spi.h"
#include "hal/stored_settings.h"

namespace {

// Commands, table 20.
constexpr uint8_t W_REGISTER = 0x20;
constexpr uint8_t R_RX_PL_WID = 0x60;
constexpr uint8_t R_RX_PAYLOAD = 0x61;
constexpr uint8_t W_TX_PAYLOAD = 0xA0;
constexpr uint8_t FLUSH_TX = 0xE1;
constexpr uint8_t FLUSH_RX = 0xE2;
constexpr uint8_t NOP = 0xFF;
constexpr uint8_t ACTIVATE = 0x50;  // nRF24L01 product specification 2.0, table 8
constexpr uint8_t ACTIVATE_KEY = 0x73;

// Registers, table 28.
constexpr uint8_t CONFIG = 0x00;
constexpr uint8_t EN_AA = 0x01;
constexpr uint8_t EN_RXADDR = 0x02;
constexpr uint8_t SETUP_AW = 0x03;
constexpr uint8_t SETUP_RETR = 0x04;
constexpr uint8_t RF_CH = 0x05;
constexpr uint8_t RF_SETUP = 0x06;
constexpr uint8_t STATUS = 0x07;
constexpr uint8_t OBSERVE_TX = 0x08;
constexpr uint8_t RPD = 0x09;
constexpr uint8_t RX_ADDR_P0 = 0x0A;
constexpr uint8_t TX_ADDR = 0x10;
constexpr uint8_t FIFO_STATUS = 0x17;
constexpr uint8_t DYNPD = 0x1C;
constexpr uint8_t FEATURE = 0x1D;

constexpr uint8_t CONFIG_POWER_UP = 1 << 1;
constexpr uint8_t CONFIG_RECEIVE = 1 << 0;
constexpr uint8_t CONFIG_CRC_16 = 1 << 3 | 1 << 2;
constexpr uint8_t FEATURE_DYNAMIC_LENGTH = 1 << 2;
constexpr uint8_t ALL_PIPES = 0x3F;
constexpr uint8_t ADDRESS_WIDTH_5 = 3;
constexpr uint8_t ADDRESS_SIZE = 5;
constexpr uint8_t FIFO_RX_EMPTY = 1 << 0;
constexpr uint8_t FIFO_RX_FULL = 1 << 1;

// Status register, section 9.1: interrupt causes.
constexpr uint8_t CAUSE_RECEIVED = 1 << 6;
constexpr uint8_t CAUSE_SENT = 1 << 5;
constexpr uint8_t CAUSE_GAVE_UP = 1 << 4;
constexpr uint8_t CAUSES = CAUSE_RECEIVED | CAUSE_SENT | CAUSE_GAVE_UP;

constexpr uint8_t RATE_250_KBPS = 1 << 5;
constexpr uint8_t RATE_2000_KBPS = 1 << 3;

constexpr uint8_t POWER_UP_MS = 5;  // table 16: up to 4.5 ms for a crystal of 90 mH

// Registers that are read back after the set-up and from time to time.
constexpr uint8_t CHECKED[] = {CONFIG, EN_AA, EN_RXADDR, SETUP_AW, RF_CH, RF_SETUP, DYNPD, FEATURE};
// RF_SETUP without the PLL's lock and without bit 0, which clones use otherwise.
constexpr uint8_t RF_SETUP_USED = 0xAE;

// One retry by the chip alone, then a new round: 24 attempts in all.
constexpr uint8_t RETRIES = 1;
constexpr uint8_t ROUNDS = 12;
// Pauses in units of 250 us. The steps are longer than a full packet with its acknowledgement (0.33,
// 0.53 and 1.74 ms), so that two different draws keep clear of each other; the shortest waits for
// the acknowledgement (section 7.4.2 of the chip's specification).
struct Pauses {
    uint8_t step;
    uint8_t count;
    uint16_t round_step_us;
};
constexpr Pauses PAUSES_250 = {7, 3, 2000};
constexpr Pauses PAUSES_1000 = {3, 5, 1000};
constexpr Pauses PAUSES_2000 = {2, 5, 1000};
constexpr uint8_t PAUSE_FIRST = 2;
constexpr bool fits(const Pauses &pauses) {
    return PAUSE_FIRST + pauses.step * (pauses.count - 1) <= 16;
}
static_assert(fits(PAUSES_250) && fits(PAUSES_1000) && fits(PAUSES_2000),
              "the chip pauses up to 4 ms");
constexpr uint32_t LOST_US = 50000;
constexpr uint32_t LONGEST_PACKET_US = 2000;  // 1.4 ms, and its acknowledgement

uint8_t config;
uint8_t pipes;     // mask of those in use
uint8_t own_pipe;  // of the address in RX_ADDR_P0
bool activated;

uint8_t rf_setup() {
    const SettingsBlock &settings = stored_settings();
    const uint8_t rate = settings.radio_kbps == 250    ? RATE_250_KBPS
                         : settings.radio_kbps == 2000 ? RATE_2000_KBPS
                                                       : 0;
    return static_cast<uint8_t>(rate | settings.radio_power << 1);
}

uint8_t command(uint8_t code, const uint8_t *out, uint8_t *in, uint8_t size) {
    spi_select_radio(true);
    const uint8_t status = spi_transfer(code);
    for (uint8_t i = 0; i < size; ++i) {
        const uint8_t byte = spi_transfer(out != nullptr ? out[i] : NOP);
        if (in != nullptr) {
            in[i] = byte;
        }
    }
    spi_select_radio(false);
    return status;
}

void write_register(uint8_t address, uint8_t value) {
    command(W_REGISTER | address, &value, nullptr, 1);
}

uint8_t read_register(uint8_t address) {
    uint8_t value = 0;
    command(address, nullptr, &value, 1);  // R_REGISTER is code 0
    return value;
}

// Pipes 1 to 5 share four bytes and differ in the lowest, which is sent first. The chosen bytes
// are neither runs of equal bits nor like a preamble.
void fill_address(uint8_t of_pipe, uint8_t bytes[ADDRESS_SIZE]) {
    const uint32_t upper = stored_settings().radio_address;
    bytes[0] = static_cast<uint8_t>(0x93 + 0x11 * of_pipe);
    for (uint8_t i = 1; i < ADDRESS_SIZE; ++i) {
        bytes[i] = static_cast<uint8_t>(upper >> 8 * (i - 1));
    }
}

void write_address(uint8_t address, uint8_t of_pipe) {
    uint8_t bytes[ADDRESS_SIZE];
    fill_address(of_pipe, bytes);
    const bool shared = address > RX_ADDR_P0 + 1 && address < TX_ADDR;
    command(W_REGISTER | address, bytes, nullptr, shared ? 1 : ADDRESS_SIZE);
}

// What a checked register is set to.
uint8_t wanted(uint8_t address) {
    switch (address) {
        case CONFIG:
            return config;
        case SETUP_AW:
            return ADDRESS_WIDTH_5;
        case RF_CH:
            return stored_settings().radio_channel;
        case RF_SETUP:
            return rf_setup();
        case FEATURE:
            return FEATURE_DYNAMIC_LENGTH;
        default:
            return pipes;  // EN_AA, EN_RXADDR, DYNPD
    }
}

// An nRF24L01 without the plus, and clones of it, hide FEATURE and DYNPD until ACTIVATE is sent; sent
// again, it hides them again.
void write_feature() {
    write_register(FEATURE, FEATURE_DYNAMIC_LENGTH);
    activated = read_register(FEATURE) != FEATURE_DYNAMIC_LENGTH;
    if (activated) {
        const uint8_t key = ACTIVATE_KEY;
        command(ACTIVATE, &key, nullptr, 1);
        write_register(FEATURE, FEATURE_DYNAMIC_LENGTH);
    }
}

void set_up(uint8_t pipe_mask, uint8_t pipe) {
    spi_enable_radio(false);
    pipes = pipe_mask;
    own_pipe = pipe;
    config = CONFIG_CRC_16;
    write_feature();
    for (const uint8_t address : CHECKED) {
        write_register(address, wanted(address));
    }
    command(FLUSH_TX, nullptr, nullptr, 0);
    command(FLUSH_RX, nullptr, nullptr, 0);
    write_register(STATUS, CAUSES);
}

WireRadioState power_up(uint8_t mode) {
    config = CONFIG_CRC_16 | CONFIG_POWER_UP | mode;
    write_register(CONFIG, config);
    board_wait_ms(POWER_UP_MS);
    return radio_check();
}

const Pauses &pauses() {
    const uint16_t kbps = stored_settings().radio_kbps;
    return kbps == 250 ? PAUSES_250 : kbps == 1000 ? PAUSES_1000 : PAUSES_2000;
}

// Up to `RETRIES` further attempts, each a drawn number of 250 us after the last.
void write_retries(uint16_t random) {
    const Pauses &drawn = pauses();
    const uint8_t pause = static_cast<uint8_t>(PAUSE_FIRST + drawn.step * ((random >> 4) % drawn.count));
    write_register(SETUP_RETR, static_cast<uint8_t>((pause - 1) << 4 | RETRIES));
}

// Reading clears them: the status comes back while the clearing byte goes out.
uint8_t take_causes() {
    const uint8_t causes = CAUSES;
    return command(W_REGISTER | STATUS, &causes, nullptr, 1) & CAUSES;
}

}  // namespace

void radio_start_pins() {
    spi_start();
    lines_start_radio(false);
}

WireRadioState radio_start_sender(uint8_t pipe) {
    set_up(1, pipe);
    write_address(TX_ADDR, pipe);
    write_address(RX_ADDR_P0, pipe);  // the acknowledgement comes to the address it was sent to
    return power_up(0);
}

WireRadioState radio_start_receiver() {
    set_up(ALL_PIPES, 0);
    for (uint8_t pipe = 0; pipe < WIRE_PIPES; ++pipe) {
        write_address(static_cast<uint8_t>(RX_ADDR_P0 + pipe), pipe);
    }
    const WireRadioState state = power_up(CONFIG_RECEIVE);
    spi_enable_radio(true);
    return state;
}

WireRadioState radio_check() {
    uint8_t zeros = 0;
    uint8_t ones = 0xFF;
    bool kept = true;
    for (const uint8_t address : CHECKED) {
        const uint8_t value = read_register(address);
        zeros |= value;
        ones &= value;
        const uint8_t mask = address == RF_SETUP ? RF_SETUP_USED : 0xFF;
        kept = kept && ((value ^ wanted(address)) & mask) == 0;
    }
    if (zeros == 0 || ones == 0xFF) {
        return WIRE_RADIO_ABSENT;
    }
    uint8_t address[ADDRESS_SIZE];
    uint8_t read[ADDRESS_SIZE];
    fill_address(own_pipe, address);
    command(RX_ADDR_P0, nullptr, read, ADDRESS_SIZE);
    if (!kept || memcmp(read, address, ADDRESS_SIZE) != 0) {
        return WIRE_RADIO_LOSES_SETTINGS;
    }
    return activated ? WIRE_RADIO_ACTIVATED : WIRE_RADIO_OK;
}

RadioTiming radio_timing() { return RadioTiming{ROUNDS, 1, pauses().round_step_us, LOST_US}; }

void radio_send(const uint8_t *payload, uint8_t size, uint16_t random) {
    write_retries(random);
    command(W_TX_PAYLOAD, payload, nullptr, size);
    spi_enable_radio(true);
}

void radio_send_again(uint16_t random) {
    // CE must fall and rise for a new round: section 6.1.4.
    spi_enable_radio(false);
    write_retries(random);
    spi_enable_radio(true);
}

RadioProgress radio_progress() {
    if (!lines_radio_active()) {
        return RADIO_PENDING;
    }
    return (take_causes() & CAUSE_SENT) != 0 ? RADIO_SENT : RADIO_GAVE_UP;
}

void radio_stop_sending() {
    spi_enable_radio(false);
    command(FLUSH_TX, nullptr, nullptr, 0);
}

uint8_t radio_retries() { return read_register(OBSERVE_TX) & 0x0F; }

bool radio_has_received() {
    if (!lines_radio_active()) {
        return false;
    }
    // Causes are cleared before the FIFO is read, so that a packet that comes meanwhile pulls the
    // line low again.
    take_causes();
    return true;
}

bool radio_receive(RadioPacket *packet) {
    const uint8_t fifo = read_register(FIFO_STATUS);
    if ((fifo & FIFO_RX_EMPTY) != 0) {
        return false;
    }
    packet->fifo_full = (fifo & FIFO_RX_FULL) != 0;
    packet->signal = WireSignal{};
    const uint8_t status = command(R_RX_PL_WID, nullptr, &packet->size, 1);
    packet->pipe = (status >> 1) & 0x07;
    if (packet->size == 0 || packet->size > WIRE_MAX_PAYLOAD || packet->pipe >= WIRE_PIPES) {
        command(FLUSH_RX, nullptr, nullptr, 0);  // R_RX_PL_WID asks for it: table 20, note
        return false;
    }
    command(R_RX_PAYLOAD, nullptr, packet->payload, packet->size);
    return true;
}

// Leaving and entering reception makes the carrier detector measure again.
void radio_measure_carrier() {
    spi_enable_radio(false);
    spi_enable_radio(true);
}

// Whether a carrier above -64 dBm was on the channel.
bool radio_carrier() { return (read_register(RPD) & 1) != 0; }

uint32_t radio_longest_packet_us() { return LONGEST_PACKET_US; }
