// SPDX-License-Identifier: Apache-2.0
// Events from the interrupts to the main loop, and the sleep between them.
#pragma once

#include <stdint.h>

enum Event : uint8_t {
    EVENT_TICK = 1 << 0,   // a millisecond has passed
    EVENT_IMU = 1 << 1,    // the IMU has a sample
    EVENT_RADIO = 1 << 2,  // the radio's interrupt line fell
    EVENT_TWI = 1 << 3,    // a transfer ended
    EVENT_UART = 1 << 4,   // a byte came in
};

// Sleeps until at least one event since the last call. The caller then checks the drivers' states,
// not the event, so an event that was consumed during a set-up is never missed.
void events_wait();
