// SPDX-License-Identifier: Apache-2.0
#include "hal/spi.h"

#include <avr/io.h>

namespace {

constexpr uint8_t CE = 1 << PB1;
constexpr uint8_t CSN = 1 << PB2;
constexpr uint8_t MOSI = 1 << PB3;
constexpr uint8_t SCK = 1 << PB5;

}  // namespace

void spi_start() {
    PORTB |= CSN;
    PORTB &= static_cast<uint8_t>(~CE);
    DDRB |= CE | CSN | MOSI | SCK;
    // The radio takes up to 10 Mbit/s.
    SPCR = 1 << SPE | 1 << MSTR;
    SPSR = 1 << SPI2X;
}

void spi_select_radio(bool selected) {
    if (selected) {
        PORTB &= static_cast<uint8_t>(~CSN);
    } else {
        PORTB |= CSN;
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
