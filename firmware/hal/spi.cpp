// SPDX-License-Identifier: Apache-2.0
#include "hal/spi.h"

#include <avr/io.h>

namespace {

constexpr uint8_t CE = 1 << PB1;
constexpr uint8_t CSN = 1 << PB2;
constexpr uint8_t MOSI = 1 << PB3;
constexpr uint8_t SCK = 1 << PB5;

constexpr uint8_t MASTER = 1 << SPE | 1 << MSTR;
constexpr uint8_t RELEASED = 1 << MSTR;  // the port's bit drives the clock line

bool idle_clock_high;

}  // namespace

void spi_start() {
    PORTB |= CSN;
    PORTB &= static_cast<uint8_t>(~CE);
    DDRB |= CE | CSN | MOSI | SCK;
    // The radio takes up to 10 Mbit/s.
    SPCR = MASTER;
    SPSR = 1 << SPI2X;
}

void spi_select_radio(bool selected) {
    if (selected) {
        SPCR = MASTER;
        PORTB &= static_cast<uint8_t>(~CSN);
    } else {
        PORTB |= CSN;
        if (idle_clock_high) {
            SPCR = RELEASED;
        }
    }
}

void spi_set_idle_clock(bool high) {
    if (high == idle_clock_high) {
        return;
    }
    idle_clock_high = high;
    if (high) {
        PORTB |= SCK;
        SPCR = RELEASED;
    } else {
        PORTB &= static_cast<uint8_t>(~SCK);
        SPCR = MASTER;
    }
}

void spi_enable_radio(bool enabled) {
    if (enabled) {
        PORTB |= CE;
    } else {
        PORTB &= static_cast<uint8_t>(~CE);
    }
}

uint8_t spi_transfer(uint8_t byte) {
    SPDR = byte;
    // A master's transfer takes 16 cycles whatever hangs on the wires: it always ends.
    while ((SPSR & 1 << SPIF) == 0) {
    }
    return SPDR;
}
