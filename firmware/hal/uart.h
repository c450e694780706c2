// SPDX-License-Identifier: Apache-2.0
// The UART, 8N1, with a ring in each direction. EVENT_UART signals a received byte.
#pragma once

#include <stdint.h>

// `tx_ring` must stay; it takes one byte less than its size.
void uart_start(uint32_t baud, uint8_t *tx_ring, uint16_t tx_size);

// Queues all of `bytes` or, if they do not fit, none.
bool uart_write(const uint8_t *bytes, uint8_t size);

// True until the last byte has left the shift register.
bool uart_writing();

// Takes one received byte.
bool uart_read(uint8_t *byte);

// Bytes lost or damaged (overrun, framing, ring full), wraps.
uint16_t uart_errors();
