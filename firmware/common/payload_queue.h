// SPDX-License-Identifier: Apache-2.0
// Payloads that wait for the radio. If it does not keep up the oldest is dropped: a fresh sample is
// worth more than a stale one.
#pragma once

#include <stdint.h>

#include "common/wire.h"

constexpr uint8_t PAYLOAD_QUEUE_SIZE = 8;

struct Payload {
    uint8_t size;
    uint8_t bytes[WIRE_MAX_PAYLOAD];
};

struct PayloadQueue {
    uint8_t first;
    uint8_t count;
    uint16_t dropped;  // wraps
    Payload payloads[PAYLOAD_QUEUE_SIZE];
};

// `front_in_use`: the radio is sending the front one, so the next oldest goes in its place.
void payload_queue_push(PayloadQueue *queue, const void *bytes, uint8_t size, bool front_in_use);

// The oldest payload, or null.
const Payload *payload_queue_front(const PayloadQueue *queue);

void payload_queue_pop(PayloadQueue *queue);
