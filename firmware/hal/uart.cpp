// SPDX-License-Identifier: Apache-2.0
#include "hal/uart.h"

#include <avr/interrupt.h>
#include <avr/io.h>
#include <util/atomic.h>

#include "hal/events.h"
#include "settings.h"

namespace {

// One UBX-NAV-PVT and the acknowledgements around it.
constexpr uint8_t RX_SIZE = 128;

// Rings between the interrupts and the main loop. Each index has one writer.
uint8_t *tx_ring;
uint16_t tx_size;
volatile uint16_t tx_first;
volatile uint16_t tx_end;
uint8_t rx_ring[RX_SIZE];
volatile uint8_t rx_first;
volatile uint8_t rx_end;
volatile uint16_t rx_errors;
bool sent_something;

uint16_t tx_after(uint16_t index) { return index + 1 == tx_size ? 0 : index + 1; }

}  // namespace

ISR(USART_UDRE_vect) {
    const uint16_t first = tx_first;
    if (first == tx_end) {
        UCSR0B &= static_cast<uint8_t>(~(1 << UDRIE0));
        return;
    }
    UCSR0A = 1 << U2X0 | 1 << TXC0;
    UDR0 = tx_ring[first];
    tx_first = tx_after(first);
}

ISR(USART_RX_vect) {
    const uint8_t status = UCSR0A;
    const uint8_t byte = UDR0;
    const uint8_t next = (rx_end + 1) % RX_SIZE;
    if ((status & (1 << FE0 | 1 << DOR0)) != 0 || next == rx_first) {
        rx_errors = rx_errors + 1;
    }
    if ((status & 1 << FE0) != 0 || next == rx_first) {
        return;
    }
    rx_ring[rx_end] = byte;
    rx_end = next;
    GPIOR0 |= EVENT_UART;
}

void uart_start(uint32_t baud, uint8_t *ring, uint16_t size) {
    UCSR0B = 0;
    tx_ring = ring;
    tx_size = size;
    const uint16_t divisor = static_cast<uint16_t>((F_CPU / 4 / baud + 1) / 2 - 1);
    UCSR0A = 1 << U2X0;
    UBRR0H = static_cast<uint8_t>(divisor >> 8);
    UBRR0L = static_cast<uint8_t>(divisor);
    UCSR0C = 1 << UCSZ01 | 1 << UCSZ00;
    UCSR0B = 1 << RXEN0 | 1 << TXEN0 | 1 << RXCIE0;
    tx_first = tx_end = 0;
    rx_first = rx_end = 0;
    sent_something = false;
}

bool uart_write(const uint8_t *bytes, uint8_t size) {
    uint16_t first;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { first = tx_first; }
    uint16_t end = tx_end;
    const uint16_t used = end >= first ? end - first : end + tx_size - first;
    if (size >= tx_size - used) {
        return false;
    }
    for (uint8_t i = 0; i < size; ++i) {
        tx_ring[end] = bytes[i];
        end = tx_after(end);
    }
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) {
        tx_end = end;
        UCSR0B |= 1 << UDRIE0;
    }
    sent_something = true;
    return true;
}

bool uart_writing() {
    const bool queued = (UCSR0B & 1 << UDRIE0) != 0;
    return sent_something && (queued || (UCSR0A & 1 << TXC0) == 0);
}

bool uart_read(uint8_t *byte) {
    const uint8_t first = rx_first;
    if (first == rx_end) {
        return false;
    }
    *byte = rx_ring[first];
    rx_first = (first + 1) % RX_SIZE;
    return true;
}

uint16_t uart_errors() {
    uint16_t count;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { count = rx_errors; }
    return count;
}
