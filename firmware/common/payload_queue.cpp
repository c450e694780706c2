// SPDX-License-Identifier: Apache-2.0
#include "common/payload_queue.h"

#include <string.h>

void payload_queue_push(PayloadQueue *queue, const void *bytes, uint8_t size, bool front_in_use) {
    if (queue->count == PAYLOAD_QUEUE_SIZE) {
        if (front_in_use) {
            const uint8_t second = static_cast<uint8_t>((queue->first + 1) % PAYLOAD_QUEUE_SIZE);
            queue->payloads[second] = queue->payloads[queue->first];
        }
        payload_queue_pop(queue);
        ++queue->dropped;
    }
    Payload *slot = &queue->payloads[(queue->first + queue->count) % PAYLOAD_QUEUE_SIZE];
    slot->size = size;
    memcpy(slot->bytes, bytes, size);
    ++queue->count;
}

const Payload *payload_queue_front(const PayloadQueue *queue) {
    return queue->count == 0 ? nullptr : &queue->payloads[queue->first];
}

void payload_queue_pop(PayloadQueue *queue) {
    if (queue->count == 0) {
        return;
    }
    queue->first = static_cast<uint8_t>((queue->first + 1) % PAYLOAD_QUEUE_SIZE);
    --queue->count;
}
