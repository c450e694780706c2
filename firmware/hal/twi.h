// SPDX-License-Identifier: Apache-2.0
// I2C master at 400 kHz, driven by interrupts, one transfer at a time: an optional write, then an
// optional read behind a repeated start. EVENT_TWI signals its end.
#pragma once

#include <stdint.h>

enum TwiState : uint8_t { TWI_IDLE, TWI_BUSY, TWI_DONE, TWI_FAILED };

constexpr uint8_t TWI_MAX_WRITE = 4;

void twi_start();

// Begins a transfer; the bus must not be busy. `read` is filled before the state says TWI_DONE.
void twi_begin(uint8_t address, const uint8_t *write, uint8_t write_size, uint8_t *read,
               uint8_t read_size);

// State of the last transfer. One that takes too long fails here: the bus is freed by clocking a
// hung slave through its byte.
TwiState twi_poll(uint32_t now_us);

// The same, asleep until it ends: for set-up alone. True if it succeeded.
bool twi_run(uint8_t address, const uint8_t *write, uint8_t write_size, uint8_t *read,
             uint8_t read_size);

// Whether a device answers at the address; its register pointer is at 0 then. For set-up alone, and
// no answer is no failure.
bool twi_answers(uint8_t address);

// Transfers that failed, wraps.
uint16_t twi_errors();
