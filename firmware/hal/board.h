// SPDX-License-Identifier: Apache-2.0
// Functions of every board: reset cause, watchdog and supply voltage.
#pragma once

#include <stdint.h>

// MCUSR as it was at the start: bit 0 power-on, 1 external, 2 brown-out, 3 watchdog.
uint8_t board_reset_cause();

// Whether the supply came up or somebody pressed reset, as opposed to a restart in flight.
bool board_started_cold();

// Starts clock, interrupts and the watchdog, which resets the board 0.25 s after it was last fed.
void board_start();
void board_feed_watchdog();

// Has the watchdog restart the program by an interrupt, which then jumps to its start. For old
// bootloaders: after a reset by the watchdog they leave it on, at 16 ms, and never get past it. Only a
// program that hangs with interrupts off is still reset.
void board_restart_softly();

// Asleep for about this long, watchdog fed: for set-up alone.
void board_wait_ms(uint8_t ms);

// Supply in mV by the chip's 1.1 V reference (10 % from chip to chip), measured since the last
// call; 0 at the first.
uint16_t board_supply_mv();
