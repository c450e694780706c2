// SPDX-License-Identifier: Apache-2.0
// Semtech SX1276, SX1277, SX1278 and the modules with them (RFM95, RFM96, RFM98) as LoRa modems:
// explicit header, CRC, and channel activity detection before each packet. Datasheet revision 7.
//
// The chip has no acknowledgements. A node listens before it sends: as long as it detects a packet it
// waits for a random time. Two nodes that listen at the same moment do not notice each other, and that
// is likely: those that have waited for the end of a packet want to send at once, and nodes of one rate
// sample together for minutes. So a node that finds the channel free waits for a random time once more,
// and sends if it is still free.
//
// The version register is not asked for: look-alikes have other values, so a
// chip is accepted if it keeps its configuration.
//
// D9 is the reset line (NRESET), D3 is DIO0.
#include <string.h>

#include "common/lora.h"
#include "drivers/radio.h"
#include "hal/board.h"
#include "hal/lines.h"
#include "hal/spi.h"
#include "hal/stored_settings.h"

namespace {

// Registers, table 41.
constexpr uint8_t FIFO = 0x00;
constexpr uint8_t OP_MODE = 0x01;
constexpr uint8_t FRF_MSB = 0x06;
constexpr uint8_t FRF_MID = 0x07;
constexpr uint8_t FRF_LSB = 0x08;
constexpr uint8_t PA_CONFIG = 0x09;
constexpr uint8_t OCP = 0x0B;
constexpr uint8_t LNA = 0x0C;
constexpr uint8_t FIFO_ADDR_PTR = 0x0D;
constexpr uint8_t FIFO_TX_BASE = 0x0E;
constexpr uint8_t FIFO_RX_BASE = 0x0F;
constexpr uint8_t FIFO_RX_CURRENT = 0x10;
constexpr uint8_t IRQ_FLAGS = 0x12;
constexpr uint8_t RX_NB_BYTES = 0x13;
constexpr uint8_t PKT_SNR = 0x19;
constexpr uint8_t PKT_RSSI = 0x1A;
constexpr uint8_t RSSI = 0x1B;
constexpr uint8_t HOP_CHANNEL = 0x1C;
constexpr uint8_t MODEM_CONFIG_1 = 0x1D;
constexpr uint8_t MODEM_CONFIG_2 = 0x1E;
constexpr uint8_t PREAMBLE_LSB = 0x21;
constexpr uint8_t PAYLOAD_LENGTH = 0x22;
constexpr uint8_t MODEM_CONFIG_3 = 0x26;
constexpr uint8_t IF_FREQ_1 = 0x2F;
constexpr uint8_t IF_FREQ_2 = 0x30;
constexpr uint8_t DETECT_OPTIMIZE = 0x31;
constexpr uint8_t HIGH_BW_OPTIMIZE_1 = 0x36;
constexpr uint8_t SYNC_WORD = 0x39;
constexpr uint8_t HIGH_BW_OPTIMIZE_2 = 0x3A;
constexpr uint8_t DIO_MAPPING_1 = 0x40;
constexpr uint8_t PA_DAC = 0x4D;
constexpr uint8_t WRITE = 0x80;
constexpr uint8_t WRITE_FIFO = WRITE;  // the FIFO has the address 0

// RegOpMode: LoRa, registers of the high or the low bands, and the mode.
constexpr uint8_t MODE_LORA = 0x80;
constexpr uint8_t MODE_LOW_FREQUENCY = 0x08;
constexpr uint8_t MODE_SLEEP = 0;
constexpr uint8_t MODE_STANDBY = 1;
constexpr uint8_t MODE_SEND = 3;
constexpr uint8_t MODE_RECEIVE = 5;
constexpr uint8_t MODE_DETECT = 7;

constexpr uint8_t IRQ_RX_DONE = 1 << 6;
constexpr uint8_t IRQ_CRC_ERROR = 1 << 5;
constexpr uint8_t IRQ_TX_DONE = 1 << 3;
constexpr uint8_t IRQ_CAD_DONE = 1 << 2;
constexpr uint8_t IRQ_CAD_DETECTED = 1 << 0;
constexpr uint8_t HOP_CRC_ON = 1 << 6;  // the packet's header says that it has a CRC

constexpr uint8_t DIO0_RX_DONE = 0x00;
constexpr uint8_t DIO0_TX_DONE = 0x40;
constexpr uint8_t DIO0_CAD_DONE = 0x80;

constexpr uint8_t PA_BOOST = 0x80;
constexpr uint8_t PA_DAC_DEFAULT = 0x84;
constexpr uint8_t PA_DAC_20_DBM = 0x87;
constexpr uint8_t OCP_100_MA = 0x20 | 11;  // 45 mA + 5 mA a step; 17 dBm take 87 mA
constexpr uint8_t OCP_140_MA = 0x20 | 17;  // -30 mA + 10 mA a step; 20 dBm take 120 mA
constexpr uint8_t LNA_BOOST = 0x23;
constexpr uint8_t CRC_ON = 1 << 2;
constexpr uint8_t AUTOMATIC_GAIN = 1 << 2;

constexpr uint8_t TX_BASE = 0x80;
constexpr uint8_t RX_BASE = 0x00;

// First byte of each of our packets: five fixed bits, and the pipe.
constexpr uint8_t PREFIX = 0xA8;
constexpr uint8_t PREFIX_PIPE = 0x07;

constexpr uint32_t LOW_BANDS_END_KHZ = 525000;  // table 33
// RSSI of the value 0, section 5.5.5.
constexpr uint8_t MINUS_RSSI_HIGH = 157;
constexpr uint8_t MINUS_RSSI_LOW = 164;
constexpr uint8_t MINUS_CARRIER_DBM = 100;  // 14 dB above the noise of 250 kHz

constexpr uint8_t RESET_MS = 6;     // section 7.2.2: 5 ms until the chip is ready
constexpr uint8_t ROUNDS = 24;
constexpr uint8_t LEAST_STEPS = 32;
constexpr uint16_t TURNAROUND_US = 600;  // from a symbol of detection to the first of a packet
constexpr uint32_t MARGIN_US = 50000;

// Registers that are read back after the set-up and from time to time.
constexpr uint8_t CHECKED[] = {OP_MODE,        FRF_MSB,   FRF_MID,      FRF_LSB,       PA_CONFIG,
                               MODEM_CONFIG_1, SYNC_WORD, FIFO_TX_BASE, MODEM_CONFIG_2};

uint8_t own_prefix;
RadioTiming timing;
bool busy;  // the channel is not known to be free
bool gave_up;
bool has_packet;

uint8_t access(uint8_t address, const uint8_t *out, uint8_t *in, uint8_t size) {
    spi_select_radio(true);
    spi_transfer(address);
    uint8_t byte = 0;
    for (uint8_t i = 0; i < size; ++i) {
        byte = spi_transfer(out != nullptr ? out[i] : 0);
        if (in != nullptr) {
            in[i] = byte;
        }
    }
    spi_select_radio(false);
    return byte;
}

void write_register(uint8_t address, uint8_t value) { access(WRITE | address, &value, nullptr, 1); }

uint8_t read_register(uint8_t address) { return access(address, nullptr, nullptr, 1); }

LoraModem modem() {
    const SettingsBlock &settings = stored_settings();
    return LoraModem{settings.lora_spreading, settings.lora_bandwidth_khz, settings.lora_coding};
}

bool in_low_bands() { return stored_settings().lora_frequency_khz < LOW_BANDS_END_KHZ; }

void set_mode(uint8_t mode) {
    write_register(OP_MODE, static_cast<uint8_t>(MODE_LORA | (in_low_bands() ? MODE_LOW_FREQUENCY : 0) | mode));
}

bool above_17_dbm() { return stored_settings().lora_power_dbm > 17; }

// The values of the checked registers, but for the mode.
uint8_t wanted(uint8_t address) {
    const SettingsBlock &settings = stored_settings();
    // In steps of 32 MHz / 2^19.
    const uint32_t frf = settings.lora_frequency_khz * 2048UL / 125UL;
    switch (address) {
        case FRF_MSB:
            return static_cast<uint8_t>(frf >> 16);
        case FRF_MID:
            return static_cast<uint8_t>(frf >> 8);
        case FRF_LSB:
            return static_cast<uint8_t>(frf);
        case PA_CONFIG:
            return static_cast<uint8_t>(PA_BOOST | (settings.lora_power_dbm - (above_17_dbm() ? 5 : 2)));
        case MODEM_CONFIG_1: {
            const uint8_t bandwidth = settings.lora_bandwidth_khz == 125 ? 7 : settings.lora_bandwidth_khz == 250 ? 8 : 9;
            return static_cast<uint8_t>(bandwidth << 4 | (settings.lora_coding - 4) << 1);
        }
        case MODEM_CONFIG_2:
            return static_cast<uint8_t>(settings.lora_spreading << 4 | CRC_ON);
        case SYNC_WORD:
            return settings.lora_sync_word;
        case FIFO_TX_BASE:
            return TX_BASE;
        default:
            return static_cast<uint8_t>(MODE_LORA | (in_low_bands() ? MODE_LOW_FREQUENCY : 0));
    }
}

// Errata 2.1 (reception of spurious signals) and 2.3 (sensitivity at 500 kHz).
void apply_errata() {
    const bool wide = stored_settings().lora_bandwidth_khz == 500;
    write_register(DETECT_OPTIMIZE, wide ? 0xC3 : 0x43);
    if (wide) {
        write_register(HIGH_BW_OPTIMIZE_1, 0x02);
        write_register(HIGH_BW_OPTIMIZE_2, in_low_bands() ? 0x7F : 0x64);
    } else {
        write_register(IF_FREQ_1, 0x40);
        write_register(IF_FREQ_2, 0x00);
    }
}

WireRadioState set_up(uint8_t prefix) {
    own_prefix = prefix;
    // A step lasts longer than the detection and the turn to sending, in which another node's packet
    // is not noticed.
    timing = RadioTiming{ROUNDS, LEAST_STEPS, static_cast<uint16_t>(lora_symbol_us(modem()) + TURNAROUND_US),
                         radio_longest_packet_us() + MARGIN_US};
    has_packet = busy = gave_up = false;
    spi_enable_radio(false);
    board_wait_ms(1);
    spi_enable_radio(true);
    board_wait_ms(RESET_MS);
    set_mode(MODE_SLEEP);  // only there may LoRa be entered
    for (uint8_t i = 1; i < sizeof CHECKED; ++i) {
        write_register(CHECKED[i], wanted(CHECKED[i]));
    }
    write_register(PA_DAC, above_17_dbm() ? PA_DAC_20_DBM : PA_DAC_DEFAULT);
    write_register(OCP, above_17_dbm() ? OCP_140_MA : OCP_100_MA);
    write_register(LNA, LNA_BOOST);
    write_register(FIFO_RX_BASE, RX_BASE);
    write_register(PREAMBLE_LSB, LORA_PREAMBLE_SYMBOLS);
    write_register(MODEM_CONFIG_3, AUTOMATIC_GAIN);
    apply_errata();
    set_mode(MODE_STANDBY);
    return radio_check();
}

void detect() {
    write_register(IRQ_FLAGS, 0xFF);
    write_register(DIO_MAPPING_1, DIO0_CAD_DONE);
    set_mode(MODE_DETECT);
}

uint8_t minus_rssi_zero() { return in_low_bands() ? MINUS_RSSI_LOW : MINUS_RSSI_HIGH; }

WireSignal signal() {
    const int8_t snr_qdb = static_cast<int8_t>(read_register(PKT_SNR));
    int16_t minus = static_cast<int16_t>(minus_rssi_zero() - read_register(PKT_RSSI));
    if (snr_qdb < 0) {
        minus = static_cast<int16_t>(minus - snr_qdb / 4);  // the packet is below the noise
    }
    return WireSignal{static_cast<uint8_t>(minus < 1 ? 1 : minus > UINT8_MAX ? UINT8_MAX : minus), snr_qdb};
}

}  // namespace

void radio_start_pins() {
    spi_start();
    lines_start_radio(true);
}

WireRadioState radio_start_sender(uint8_t pipe) { return set_up(PREFIX | pipe); }

WireRadioState radio_start_receiver() {
    const WireRadioState state = set_up(PREFIX);
    write_register(DIO_MAPPING_1, DIO0_RX_DONE);
    set_mode(MODE_RECEIVE);
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
        const uint8_t mask = address == OP_MODE ? MODE_LORA | MODE_LOW_FREQUENCY : 0xFF;
        kept = kept && ((value ^ wanted(address)) & mask) == 0;
    }
    if (zeros == 0 || ones == 0xFF) {
        return WIRE_RADIO_ABSENT;
    }
    return kept ? WIRE_RADIO_OK : WIRE_RADIO_LOSES_SETTINGS;
}

RadioTiming radio_timing() { return timing; }

void radio_send(const uint8_t *payload, uint8_t size, uint16_t) {
    write_register(FIFO_ADDR_PTR, TX_BASE);
    write_register(FIFO, own_prefix);
    access(WRITE_FIFO, payload, nullptr, size);
    write_register(PAYLOAD_LENGTH, static_cast<uint8_t>(size + 1));
    busy = true;
    detect();
}

void radio_send_again(uint16_t) { detect(); }

RadioProgress radio_progress() {
    if (!lines_radio_active()) {
        return RADIO_PENDING;
    }
    const uint8_t flags = read_register(IRQ_FLAGS);
    write_register(IRQ_FLAGS, 0xFF);
    const bool was_busy = busy;
    busy = (flags & IRQ_CAD_DETECTED) != 0;
    gave_up = busy || was_busy;
    if ((flags & IRQ_TX_DONE) != 0) {
        return RADIO_SENT;
    }
    if ((flags & IRQ_CAD_DONE) != 0 && !gave_up) {
        write_register(DIO_MAPPING_1, DIO0_TX_DONE);
        set_mode(MODE_SEND);
    }
    return gave_up ? RADIO_GAVE_UP : RADIO_PENDING;
}

void radio_stop_sending() { set_mode(MODE_STANDBY); }

uint8_t radio_retries() { return gave_up ? 1 : 0; }

bool radio_has_received() {
    if (!lines_radio_active()) {
        return false;
    }
    const uint8_t flags = read_register(IRQ_FLAGS);
    const bool crc_on = (read_register(HOP_CHANNEL) & HOP_CRC_ON) != 0;
    write_register(IRQ_FLAGS, 0xFF);
    has_packet = (flags & IRQ_RX_DONE) != 0 && (flags & IRQ_CRC_ERROR) == 0 && crc_on;
    return true;
}

bool radio_receive(RadioPacket *packet) {
    if (!has_packet) {
        return false;
    }
    has_packet = false;
    uint8_t size = read_register(RX_NB_BYTES);
    write_register(FIFO_ADDR_PTR, read_register(FIFO_RX_CURRENT));
    const uint8_t prefix = read_register(FIFO);
    const uint8_t pipe = prefix & PREFIX_PIPE;
    const bool is_ours = (prefix & ~PREFIX_PIPE) == PREFIX && pipe < WIRE_PIPES && size > 1 &&
                         size <= WIRE_MAX_PAYLOAD + 1;
    packet->fifo_full = false;
    packet->pipe = is_ours ? pipe : WIRE_NO_PIPE;
    packet->signal = signal();
    if (is_ours) {
        packet->size = static_cast<uint8_t>(size - 1);
        access(FIFO, nullptr, packet->payload, packet->size);
        return true;
    }
    if (stored_settings().lora_foreign == 0 || size == 0 || size > WIRE_MAX_FOREIGN) {
        return false;
    }
    packet->size = size;
    packet->payload[0] = prefix;
    access(FIFO, nullptr, packet->payload + 1, static_cast<uint8_t>(size - 1));
    return true;
}

// The chip measures all the time while it receives.
void radio_measure_carrier() {}

bool radio_carrier() { return read_register(RSSI) > minus_rssi_zero() - MINUS_CARRIER_DBM; }

uint32_t radio_longest_packet_us() { return lora_airtime_us(modem(), WIRE_MAX_PAYLOAD + 1); }
