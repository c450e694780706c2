// SPDX-License-Identifier: Apache-2.0
// nRF24L01+: Enhanced ShockBurst with dynamic payload length, 2-byte CRC and automatic
// acknowledgement. Product specification 1.0.
//
// Clones are used if they keep their configuration. None of what they do otherwise is used: the
// Si24R1 has the packet's NO_ACK bit reversed, which matters only with EN_DYN_ACK.
#pragma once

#include <stdint.h>

#include "common/wire.h"

// Status register, section 9.1: interrupt causes.
constexpr uint8_t NRF24_RECEIVED = 1 << 6;
constexpr uint8_t NRF24_SENT = 1 << 5;
constexpr uint8_t NRF24_GAVE_UP = 1 << 4;

// Both set the chip up and check it.
WireRadioState nrf24_start_sender(uint8_t pipe);
WireRadioState nrf24_start_receiver();

// Reads the configuration back: it is lost after a dip of the supply.
WireRadioState nrf24_check();

inline bool nrf24_usable(WireRadioState state) {
    return state == WIRE_RADIO_OK || state == WIRE_RADIO_ACTIVATED;
}

// Puts one payload on the air; the chip sends it again up to `retries` times, each `pause` times
// 250 us after the last, until it is acknowledged.
void nrf24_send(const uint8_t *payload, uint8_t size, uint8_t pause, uint8_t retries);

// Sends the payload that was given up once more, with its packet identity unchanged.
void nrf24_send_again(uint8_t pause, uint8_t retries);

// Takes the radio off the air and discards a payload not yet sent.
void nrf24_stop_sending();

// Interrupt causes; reading clears them.
uint8_t nrf24_take_causes();

// Retries that the last payload took.
uint8_t nrf24_retries();

struct Nrf24Packet {
    uint8_t pipe;
    uint8_t size;
    uint8_t payload[WIRE_MAX_PAYLOAD];
    bool fifo_full;  // it was, before this packet was taken
};

// Takes the next received packet; false if there is none.
bool nrf24_receive(Nrf24Packet *packet);

// Leaves and enters reception, so that the carrier detector measures again.
void nrf24_restart_listening();

// Whether a carrier above -64 dBm was on the channel; valid 0.2 ms after the restart.
bool nrf24_carrier();
