// SPDX-License-Identifier: Apache-2.0
// The u-blox binary protocol: a byte-wise reader, a writer, and UBX-NAV-PVT into payloads.
#pragma once

#include <stdint.h>

#include "common/wire.h"

constexpr uint8_t UBX_SYNC_1 = 0xB5;
constexpr uint8_t UBX_SYNC_2 = 0x62;
constexpr uint8_t UBX_OVERHEAD = 8;  // sync, class, id, length, checksum

constexpr uint16_t ubx_id(uint8_t message_class, uint8_t id) {
    return static_cast<uint16_t>(message_class << 8 | id);
}

constexpr uint16_t UBX_NAV_PVT = ubx_id(0x01, 0x07);
constexpr uint16_t UBX_ACK_NAK = ubx_id(0x05, 0x00);
constexpr uint16_t UBX_ACK_ACK = ubx_id(0x05, 0x01);
constexpr uint16_t UBX_CFG_PRT = ubx_id(0x06, 0x00);
constexpr uint16_t UBX_CFG_MSG = ubx_id(0x06, 0x01);
constexpr uint16_t UBX_CFG_RATE = ubx_id(0x06, 0x08);
constexpr uint16_t UBX_CFG_NAV5 = ubx_id(0x06, 0x24);

constexpr uint8_t UBX_NAV_PVT_SIZE = 92;

// Reader. A message longer than the buffer is dropped at its length field; whatever is broken,
// the next sync bytes start again.
struct UbxReader {
    uint8_t state;
    uint8_t check_a;
    uint8_t check_b;
    uint8_t size;
    uint8_t at;
    uint16_t id;
    uint16_t errors;  // checksums and lengths that did not hold, wraps
    uint8_t payload[UBX_NAV_PVT_SIZE];
};

// Takes one byte. True if it completes a message: `id`, `size` and `payload` hold until the next.
bool ubx_read(UbxReader *reader, uint8_t byte);

// True if the last byte may be the first of a message.
bool ubx_begun(const UbxReader *reader);

// Gives up a message, if one is being read, whose rest stays away.
void ubx_cut(UbxReader *reader);

// Writes a message around `payload`; `out` holds size + UBX_OVERHEAD bytes. Returns that number.
uint8_t ubx_write(uint16_t id, const uint8_t *payload, uint8_t size, uint8_t *out);

// Fills the bodies of the two GPS payloads from a UBX-NAV-PVT; their headers are left alone.
void ubx_to_fix(const uint8_t *nav_pvt, WireGpsFix *fix);
void ubx_to_quality(const uint8_t *nav_pvt, WireGpsQuality *quality);
