// SPDX-License-Identifier: Apache-2.0
// Sends payloads in order, each until it is acknowledged or given up.
//
// | state   | event                    | action                                | next    |
// | ------- | ------------------------ | ------------------------------------- | ------- |
// | ABSENT  | 0.5 s passed             | set the chip up                       | IDLE    |
// | IDLE    | a payload waits          | put it on the air                     | SENDING |
// | SENDING | sent                     | discard it                            | IDLE    |
// | SENDING | given up, rounds left    | draw some milliseconds to wait        | PAUSING |
// | PAUSING | they have passed         | draw the chip's pause, again          | SENDING |
// | SENDING | given up, no round left  | count it, discard it                  | IDLE    |
// | SENDING | the same, set-up lost    | the same                              | ABSENT  |
// | SENDING | nothing for 50 ms        | the chip is lost                      | ABSENT  |
//
// Two nodes whose packets collided would collide again if both paused for the same time; so every
// round of retries waits for a new random time, which grows with the failed rounds.
#pragma once

#include <stdint.h>

#include "common/payload_queue.h"
#include "hal/led.h"

struct RadioSender {
    uint8_t state;
    WireRadioState radio;  // at the last set-up
    bool acknowledged;  // the last payload
    uint8_t vehicle_node;
    uint8_t rounds;
    uint16_t random;
    uint16_t sequence;
    uint16_t failed;   // payloads given up, wraps
    uint16_t retries;  // wraps
    uint32_t since_us;  // of the round, or of the set-up
    PayloadQueue queue;
};

// Takes vehicle, node and pipe from the stored settings.
void radio_sender_start(RadioSender *sender);

// Numbers the payload, fills its header and queues it.
void radio_sender_push(RadioSender *sender, uint8_t kind, uint32_t node_time_us, void *payload,
                       uint8_t size);

// To be called at every event.
void radio_sender_poll(RadioSender *sender, uint32_t now_us);

// What the radio makes the LED show.
LedCode radio_sender_led(const RadioSender *sender);
