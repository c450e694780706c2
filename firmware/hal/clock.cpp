// SPDX-License-Identifier: Apache-2.0
#include "hal/clock.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "hal/events.h"
#include "settings.h"

namespace {

constexpr uint8_t TICKS_PER_US = F_CPU / 8 / 1000000UL;  // prescaler 8
constexpr uint16_t TICKS_PER_MS = TICKS_PER_US * 1000U;

}  // namespace

// Overflows of timer 1. Written by its interrupt alone; the rig sets it near the wrap, so it has a
// name that a linker sees.
volatile uint32_t clock_overflows = 0;

ISR(TIMER1_OVF_vect) { clock_overflows = clock_overflows + 1; }

ISR(TIMER1_COMPA_vect) {
    OCR1A = static_cast<uint16_t>(OCR1A + TICKS_PER_MS);
    GPIOR0 |= EVENT_TICK;
}

void clock_start() {
    TCCR1A = 0;
    TCNT1 = 0;
    OCR1A = TICKS_PER_MS;
    TIMSK1 = 1 << TOIE1 | 1 << OCIE1A;
    TCCR1B = 1 << CS11;
}

uint32_t clock_us_in_interrupt() {
    uint16_t ticks = TCNT1;
    uint32_t overflows = clock_overflows;
    if ((TIFR1 & 1 << TOV1) != 0) {
        ticks = TCNT1;
        ++overflows;  // it wrapped and its interrupt still waits
    }
    const uint32_t all_ticks = overflows << 16 | ticks;
    if (TICKS_PER_US == 1) {
        return all_ticks;
    }
    // The 33rd bit of the ticks is the 32nd of the microseconds; AVR has no quick shift by 15.
    return all_ticks >> 1 | (overflows & 0x10000 ? 0x80000000 : 0);
}

uint32_t clock_us() {
    uint32_t now_us;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { now_us = clock_us_in_interrupt(); }
    return now_us;
}
