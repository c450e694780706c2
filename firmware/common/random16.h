// SPDX-License-Identifier: Apache-2.0
// A small generator for back-off times: two nodes must not repeat the same pauses in step.
#pragma once

#include <stdint.h>

// xorshift with the triple 7, 9, 8 (Marsaglia, 2003): full period over the non-zero states.
constexpr uint16_t random16_next(uint16_t state) {
    uint16_t x = state;
    x = static_cast<uint16_t>(x ^ (x << 7));
    x = static_cast<uint16_t>(x ^ (x >> 9));
    return static_cast<uint16_t>(x ^ (x << 8));
}
