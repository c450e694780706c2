// SPDX-License-Identifier: Apache-2.0
// The u-blox binary protocol: a byte-wise reader, a writer, and solutions into payloads. Receivers
// from u-blox 7 on send a solution as one UBX-NAV-PVT; a u-blox 6 sends it in four messages.
#pragma once

#include <stdint.h>

#include "common/wire.h"

constexpr uint8_t UBX_SYNC_1 = 0xB5;
constexpr uint8_t UBX_SYNC_2 = 0x62;
constexpr uint8_t UBX_OVERHEAD = 8;  // sync, class, id, length, checksum

constexpr uint16_t ubx_id(uint8_t message_class, uint8_t id) {
    return static_cast<uint16_t>(message_class << 8 | id);
}

constexpr uint16_t UBX_NAV_POSLLH = ubx_id(0x01, 0x02);
constexpr uint16_t UBX_NAV_SOL = ubx_id(0x01, 0x06);
constexpr uint16_t UBX_NAV_PVT = ubx_id(0x01, 0x07);
constexpr uint16_t UBX_NAV_VELNED = ubx_id(0x01, 0x12);
constexpr uint16_t UBX_NAV_TIMEUTC = ubx_id(0x01, 0x21);
constexpr uint16_t UBX_ACK_NAK = ubx_id(0x05, 0x00);
constexpr uint16_t UBX_ACK_ACK = ubx_id(0x05, 0x01);
constexpr uint16_t UBX_CFG_PRT = ubx_id(0x06, 0x00);
constexpr uint16_t UBX_CFG_MSG = ubx_id(0x06, 0x01);
constexpr uint16_t UBX_CFG_RATE = ubx_id(0x06, 0x08);
constexpr uint16_t UBX_CFG_NAV5 = ubx_id(0x06, 0x24);
constexpr uint16_t UBX_CFG_VALSET = ubx_id(0x06, 0x8A);
constexpr uint16_t UBX_MON_VER = ubx_id(0x0A, 0x04);

constexpr uint8_t UBX_NAV_PVT_SIZE = 92;

// The longest message that is read: a UBX-MON-VER with twelve extensions.
constexpr uint16_t UBX_SIZE_MAX = 400;

// Reader. Of a message longer than the buffer the head is kept, one longer than UBX_SIZE_MAX is
// dropped at its length field; whatever is broken, the next sync bytes start again.
struct UbxReader {
    uint8_t state;
    uint8_t check_a;
    uint8_t check_b;
    uint16_t size;
    uint16_t at;
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

// The solution of a u-blox 6: POSLLH, SOL, VELNED and TIMEUTC of one iTOW.
struct UbxParts {
    uint32_t itow_ms;
    uint32_t begun_us;  // arrival of the first byte of its first message
    uint8_t have;
};

// Takes the message that the reader has completed, whose first byte came at `begun_us`, if it is one
// of the four. True if it completes a solution: then both payloads are filled in, all but their
// headers. Until then they are in use.
bool ubx_take_part(UbxParts *parts, const UbxReader *reader, uint32_t begun_us, WireGpsFix *fix,
                   WireGpsQuality *quality);

// The generation that a UBX-MON-VER names: 6, 7, 8, 9 or 10; 0 if it is another.
uint8_t ubx_generation(const UbxReader *reader);
