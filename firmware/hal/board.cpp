// SPDX-License-Identifier: Apache-2.0
#include "hal/board.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/wdt.h>

#include "hal/clock.h"
#include "hal/events.h"

namespace {

constexpr uint8_t ADC_SUPPLY_BY_BANDGAP = 1 << REFS0 | 0x0E;  // input 1.1 V, reference AVCC
constexpr uint32_t BANDGAP_MV = 1100;
constexpr uint32_t ADC_STEPS = 1024;

// Kept out of .bss, which the start-up code clears after it is written.
uint8_t reset_cause __attribute__((section(".noinit")));

}  // namespace

// The watchdog stays on after its own reset, at its shortest period: it must be stopped before the
// start-up code runs.
extern "C" void board_keep_reset_cause() __attribute__((naked, used, section(".init3")));
extern "C" void board_keep_reset_cause() {
    // A bootloader has cleared MCUSR before the program starts; optiboot hands it on in r2, which
    // nothing has touched yet.
    uint8_t from_bootloader;
    __asm__ __volatile__("mov %0, r2" : "=r"(from_bootloader));
    reset_cause = MCUSR != 0 ? MCUSR : from_bootloader & 0x0F;
    MCUSR = 0;
    wdt_disable();
}

uint8_t board_reset_cause() { return reset_cause; }

bool board_started_cold() { return (reset_cause & (1 << BORF | 1 << WDRF)) == 0; }

void board_start() {
    GPIOR0 = 0;
    clock_start();
    ADMUX = ADC_SUPPLY_BY_BANDGAP;
    ADCSRA = 1 << ADEN | 1 << ADPS2 | 1 << ADPS1 | 1 << ADPS0;
    wdt_enable(WDTO_250MS);
    sei();
}

void board_feed_watchdog() { wdt_reset(); }

void board_restart_softly() { WDTCSR |= 1 << WDIE; }

// Every source of interrupts off, as after a reset; the start-up code does the rest. The cause is
// handed over as optiboot does.
ISR(WDT_vect, ISR_NAKED) {
    wdt_disable();
    EIMSK = 0;
    TIMSK1 = 0;
    UCSR0B = 0;
    TWCR = 0;
    ADCSRA = 0;
    __asm__ __volatile__("mov r2, %0\n\tclr r1\n\tjmp 0" : : "r"(static_cast<uint8_t>(1 << WDRF)));
}

void board_wait_ms(uint8_t ms) {
    const uint32_t until_us = clock_us() + 1000UL * ms;
    while (!clock_passed(clock_us(), until_us)) {
        wdt_reset();
        events_wait();
    }
}

uint16_t board_supply_mv() {
    const uint16_t steps = ADC;
    ADCSRA |= 1 << ADSC;
    return steps == 0 ? 0 : static_cast<uint16_t>(BANDGAP_MV * ADC_STEPS / steps);
}
