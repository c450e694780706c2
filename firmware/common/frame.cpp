// SPDX-License-Identifier: Apache-2.0
#include "common/frame.h"

#include "common/crc16.h"

namespace {

// COBS of a run that never reaches 254 bytes, so no code byte is 0xFF.
struct Stuffer {
    uint8_t *out;
    uint8_t code_at;
    uint8_t size;
};

void stuff(Stuffer *stuffer, uint8_t byte) {
    if (byte == 0) {
        stuffer->out[stuffer->code_at] = static_cast<uint8_t>(stuffer->size - stuffer->code_at);
        stuffer->code_at = stuffer->size;
    }
    stuffer->out[stuffer->size++] = byte;
}

}  // namespace

uint8_t frame_encode(const uint8_t *content, uint8_t size, uint8_t *out) {
    Stuffer stuffer = {out, 0, 1};
    uint16_t crc = CRC16_START;
    for (uint8_t i = 0; i < size; ++i) {
        crc = crc16_update(crc, content[i]);
        stuff(&stuffer, content[i]);
    }
    stuff(&stuffer, static_cast<uint8_t>(crc));
    stuff(&stuffer, static_cast<uint8_t>(crc >> 8));
    stuff(&stuffer, 0);
    return stuffer.size;
}
