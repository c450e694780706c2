// SPDX-License-Identifier: Apache-2.0
// Serial frames: COBS(content, CRC-16) and a zero.
#pragma once

#include <stdint.h>

constexpr uint8_t FRAME_MAX_CONTENT = 72;  // the receiver's status
constexpr uint8_t FRAME_MAX_SIZE = FRAME_MAX_CONTENT + 2 + 1 + 1;  // CRC, COBS code, zero

// Writes the frame of `content` (at most FRAME_MAX_CONTENT bytes) to `out`, which holds at least
// FRAME_MAX_SIZE bytes. Returns the number of bytes written, the closing zero included.
uint8_t frame_encode(const uint8_t *content, uint8_t size, uint8_t *out);
