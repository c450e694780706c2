// SPDX-License-Identifier: Apache-2.0
// CRC-16/CCITT-FALSE: polynomial 0x1021, not reflected.
#pragma once

#include <stdint.h>

constexpr uint16_t CRC16_START = 0xFFFF;

// One more byte: the polynomial's taps folded over a whole byte, so neither a table nor a loop over
// bits is needed.
constexpr uint16_t crc16_update(uint16_t crc, uint8_t byte) {
    const uint8_t high = static_cast<uint8_t>((crc >> 8) ^ byte);
    const uint16_t x = static_cast<uint8_t>(high ^ (high >> 4));
    return static_cast<uint16_t>((crc << 8) ^ (x << 12) ^ (x << 5) ^ x);
}
