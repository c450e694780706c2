// SPDX-License-Identifier: Apache-2.0
// The radio of a board. One implementation is linked: drivers/nrf24.cpp (nRF24L01+) or
// drivers/sx1276.cpp (LoRa); nodes and receiver do not know which.
#pragma once

#include <stdint.h>

#include "common/wire.h"

// SPI and the interrupt line; before all else.
void radio_start_pins();

// Both set the chip up and check it.
WireRadioState radio_start_sender(uint8_t pipe);
WireRadioState radio_start_receiver();

// Reads the configuration back: it is lost after a dip of the supply.
WireRadioState radio_check();

inline bool radio_usable(WireRadioState state) {
    return state == WIRE_RADIO_OK || state == WIRE_RADIO_ACTIVATED;
}

enum RadioProgress : uint8_t { RADIO_PENDING, RADIO_SENT, RADIO_GAVE_UP };

// How a sender waits for the air.
struct RadioTiming {
    uint8_t rounds;          // attempts before a payload is lost
    uint8_t least_steps;     // of the range that the pause between two rounds is drawn from
    uint16_t round_step_us;
    uint32_t lost_us;        // longer than any attempt: the chip is lost
};
RadioTiming radio_timing();

// Begins an attempt to send one payload; `random` draws the pauses that the chip makes by itself.
void radio_send(const uint8_t *payload, uint8_t size, uint16_t random);

// Begins another attempt with the payload that was given up, its identity unchanged.
void radio_send_again(uint16_t random);

// To be called at every event while an attempt runs.
RadioProgress radio_progress();

// Takes the radio off the air and discards a payload not yet sent.
void radio_stop_sending();

// Attempts beyond the first that the chip made by itself for the last payload.
uint8_t radio_retries();

struct RadioPacket {
    uint8_t pipe;  // WIRE_NO_PIPE: a packet of another program
    uint8_t size;
    uint8_t payload[WIRE_MAX_FOREIGN];
    bool fifo_full;  // it was, before this packet was taken
    WireSignal signal;
};

// Whether something was received; clears the interrupt's cause.
bool radio_has_received();

// Takes the next received packet; false if there is none.
bool radio_receive(RadioPacket *packet);

// Starts a measurement of the carrier; its result is valid 0.2 ms later.
void radio_measure_carrier();
bool radio_carrier();

// A carrier that ends in a packet within this time was our own.
uint32_t radio_longest_packet_us();
