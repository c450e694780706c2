// SPDX-License-Identifier: Apache-2.0
// Time on the air of LoRa packets: SX1276 datasheet, revision 7, section 4.1.1.7.
#pragma once

#include <stdint.h>

struct LoraModem {
    uint8_t spreading;       // factor, 7 to 10
    uint16_t bandwidth_khz;  // 125, 250 or 500
    uint8_t coding;          // denominator of the coding rate 4/5 to 4/8
};

constexpr uint8_t LORA_PREAMBLE_SYMBOLS = 8;

constexpr uint32_t lora_symbol_us(const LoraModem &modem) {
    return (UINT32_C(1000) << modem.spreading) / modem.bandwidth_khz;
}

// Of a packet with explicit header and CRC. Up to a spreading factor of 10 and from 125 kHz on, no
// symbol reaches the 16 ms that need the optimisation for low data rates.
constexpr uint32_t lora_airtime_us(const LoraModem &modem, uint8_t size) {
    // 8 size - 4 SF + 28 + 16 bits in groups of 4 SF, each of `coding` symbols, rounded up.
    const uint32_t bits = UINT32_C(8) * size + 44 - UINT32_C(4) * modem.spreading;
    const uint32_t group = UINT32_C(4) * modem.spreading;
    const uint32_t payload = 8 + (bits + group - 1) / group * modem.coding;
    // The preamble has 4.25 symbols more.
    return (4 * (LORA_PREAMBLE_SYMBOLS + payload) + 17) * lora_symbol_us(modem) / 4;
}
