// SPDX-License-Identifier: Apache-2.0
// The LED on D13. It hangs on the radio's clock line, so the board shows it between transfers only;
// with no code to show, it glimmers with the radio's traffic.
#pragma once

#include <stdint.h>

// Number of flashes, each 0.13 s, in a cycle of 2.1 s. The most basic fault is shown.
enum LedCode : uint8_t {
    LED_OFF = 0,
    LED_NO_LINK = 1,    // node: the receiver does not acknowledge; receiver: no node is heard
    LED_NO_SENSOR = 2,  // a sensor is missing or failed
    LED_NO_RADIO = 3,   // the radio module does not answer or loses its configuration
    LED_SETTINGS_DAMAGED = 8,  // flashes without a pause: flash the board again
};

// To be called at least every tick.
void led_blink(LedCode code, uint32_t now_us);
