// SPDX-License-Identifier: Apache-2.0
// Time since the start, and a tick each millisecond (EVENT_TICK). Timer 1.
#pragma once

#include <stdint.h>

void clock_start();

// Microseconds since the start; wraps every 71.6 minutes. Compare only with clock_passed.
uint32_t clock_us();

// The same from inside an interrupt.
uint32_t clock_us_in_interrupt();

// Whether `now_us` has reached `due_us`, across the wrap.
inline bool clock_passed(uint32_t now_us, uint32_t due_us) {
    return static_cast<int32_t>(now_us - due_us) >= 0;
}
