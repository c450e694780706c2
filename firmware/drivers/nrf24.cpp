// SPDX-License-Identifier: Apache-2.0
#include "drivers/nrf24.h"

#include "hal/board.h"
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
constexpr uint8_t FIFO_RX_EMPTY = 1 << 0;
constexpr uint8_t FIFO_RX_FULL = 1 << 1;
constexpr uint8_t CAUSES = NRF24_RECEIVED | NRF24_SENT | NRF24_GAVE_UP;

constexpr uint8_t RATE_250_KBPS = 1 << 5;
constexpr uint8_t RATE_2000_KBPS = 1 << 3;

constexpr uint8_t POWER_UP_MS = 5;  // table 16: up to 4.5 ms for a crystal of 90 mH

uint8_t config;

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
void write_address(uint8_t address, uint8_t pipe) {
    const uint32_t upper = stored_settings().radio_address;
    const uint8_t bytes[5] = {
        static_cast<uint8_t>(0x93 + 0x11 * pipe),
        static_cast<uint8_t>(upper),
        static_cast<uint8_t>(upper >> 8),
        static_cast<uint8_t>(upper >> 16),
        static_cast<uint8_t>(upper >> 24),
    };
    const bool shared = address > RX_ADDR_P0 + 1 && address < TX_ADDR;
    command(W_REGISTER | address, bytes, nullptr, shared ? 1 : sizeof bytes);
}

void set_up_common() {
    spi_enable_radio(false);
    write_register(CONFIG, CONFIG_CRC_16);
    write_register(SETUP_AW, ADDRESS_WIDTH_5);
    write_register(RF_CH, stored_settings().radio_channel);
    write_register(RF_SETUP, rf_setup());
    write_register(FEATURE, FEATURE_DYNAMIC_LENGTH);
    command(FLUSH_TX, nullptr, nullptr, 0);
    command(FLUSH_RX, nullptr, nullptr, 0);
    write_register(STATUS, CAUSES);
}

bool power_up(uint8_t mode) {
    config = CONFIG_CRC_16 | CONFIG_POWER_UP | mode;
    write_register(CONFIG, config);
    board_wait_ms(POWER_UP_MS);
    return nrf24_configured();
}

void write_retries(uint8_t pause, uint8_t retries) {
    write_register(SETUP_RETR, static_cast<uint8_t>((pause - 1) << 4 | retries));
}

}  // namespace

bool nrf24_start_sender(uint8_t pipe) {
    set_up_common();
    write_address(TX_ADDR, pipe);
    write_address(RX_ADDR_P0, pipe);  // the acknowledgement comes to the address it was sent to
    write_register(EN_AA, 1);
    write_register(EN_RXADDR, 1);
    write_register(DYNPD, 1);
    return power_up(0);
}

bool nrf24_start_receiver() {
    set_up_common();
    for (uint8_t pipe = 0; pipe < WIRE_PIPES; ++pipe) {
        write_address(static_cast<uint8_t>(RX_ADDR_P0 + pipe), pipe);
    }
    write_register(EN_AA, ALL_PIPES);
    write_register(EN_RXADDR, ALL_PIPES);
    write_register(DYNPD, ALL_PIPES);
    const bool ok = power_up(CONFIG_RECEIVE);
    spi_enable_radio(true);
    return ok;
}

bool nrf24_configured() {
    return read_register(CONFIG) == config && read_register(RF_CH) == stored_settings().radio_channel;
}

void nrf24_send(const uint8_t *payload, uint8_t size, uint8_t pause, uint8_t retries) {
    write_retries(pause, retries);
    command(W_TX_PAYLOAD, payload, nullptr, size);
    spi_enable_radio(true);
}

void nrf24_send_again(uint8_t pause, uint8_t retries) {
    // CE must fall and rise for a new round: section 6.1.4.
    spi_enable_radio(false);
    write_retries(pause, retries);
    spi_enable_radio(true);
}

void nrf24_stop_sending() {
    spi_enable_radio(false);
    command(FLUSH_TX, nullptr, nullptr, 0);
}

uint8_t nrf24_take_causes() {
    const uint8_t causes = CAUSES;
    // The status comes back while the clearing byte goes out.
    return command(W_REGISTER | STATUS, &causes, nullptr, 1) & CAUSES;
}

uint8_t nrf24_retries() { return read_register(OBSERVE_TX) & 0x0F; }

bool nrf24_receive(Nrf24Packet *packet) {
    const uint8_t fifo = read_register(FIFO_STATUS);
    if ((fifo & FIFO_RX_EMPTY) != 0) {
        return false;
    }
    packet->fifo_full = (fifo & FIFO_RX_FULL) != 0;
    const uint8_t status = command(R_RX_PL_WID, nullptr, &packet->size, 1);
    packet->pipe = (status >> 1) & 0x07;
    if (packet->size == 0 || packet->size > WIRE_MAX_PAYLOAD || packet->pipe >= WIRE_PIPES) {
        command(FLUSH_RX, nullptr, nullptr, 0);  // R_RX_PL_WID asks for it: table 20, note
        return false;
    }
    command(R_RX_PAYLOAD, nullptr, packet->payload, packet->size);
    return true;
}

void nrf24_restart_listening() {
    spi_enable_radio(false);
    spi_enable_radio(true);
}

bool nrf24_carrier() { return (read_register(RPD) & 1) != 0; }
