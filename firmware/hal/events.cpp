// SPDX-License-Identifier: Apache-2.0
#include "hal/events.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/sleep.h>

// GPIOR0 holds the events: bits there are set by a single instruction, so interrupts need no lock.
void events_wait() {
    cli();
    while (GPIOR0 == 0) {
        set_sleep_mode(SLEEP_MODE_IDLE);
        sleep_enable();
        sei();  // acts after the next instruction: no interrupt can slip in before the sleep
        sleep_cpu();
        sleep_disable();
        cli();
    }
    GPIOR0 = 0;
    sei();
}
