// SPDX-License-Identifier: Apache-2.0
#include "hal/lines.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "hal/clock.h"
#include "hal/events.h"

namespace {

// Written by the interrupts, read with interrupts off.
volatile uint32_t imu_us;
volatile uint32_t radio_us;

bool radio_active_high;

}  // namespace

ISR(INT0_vect) {
    imu_us = clock_us_in_interrupt();
    GPIOR0 |= EVENT_IMU;
}

ISR(INT1_vect) {
    radio_us = clock_us_in_interrupt();
    GPIOR0 |= EVENT_RADIO;
}

void lines_start_imu() {
    DDRD &= static_cast<uint8_t>(~(1 << PD2));
    EICRA |= 1 << ISC01 | 1 << ISC00;
    EIFR = 1 << INTF0;
    EIMSK |= 1 << INT0;
}

void lines_start_radio(bool active_high) {
    radio_active_high = active_high;
    DDRD &= static_cast<uint8_t>(~(1 << PD3));
    if (active_high) {
        EICRA |= 1 << ISC11 | 1 << ISC10;
    } else {
        PORTD |= 1 << PD3;
        EICRA |= 1 << ISC11;
    }
    EIFR = 1 << INTF1;
    EIMSK |= 1 << INT1;
}

uint32_t lines_imu_us() {
    uint32_t time_us;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { time_us = imu_us; }
    return time_us;
}

uint32_t lines_radio_us() {
    uint32_t time_us;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { time_us = radio_us; }
    return time_us;
}

bool lines_radio_active() { return ((PIND & 1 << PD3) != 0) == radio_active_high; }
