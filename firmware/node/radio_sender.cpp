// SPDX-License-Identifier: Apache-2.0
#include "node/radio_sender.h"

#include <string.h>

#include "common/random16.h"
#include "drivers/radio.h"
#include "hal/clock.h"
#include "hal/stored_settings.h"

namespace {

enum State : uint8_t { ABSENT, IDLE, SENDING, PAUSING };

constexpr uint32_t SET_UP_EVERY_US = 500000;

uint16_t draw(RadioSender *sender) {
    sender->random = random16_next(sender->random);
    return sender->random;
}

void count_lost(RadioSender *sender) {
    ++sender->failed;
    sender->acknowledged = false;
    payload_queue_pop(&sender->queue);
    radio_stop_sending();
    sender->state = IDLE;
}

void set_up(RadioSender *sender) {
    sender->radio = radio_start_sender(stored_settings().radio_pipe);
    sender->state = radio_usable(sender->radio) ? IDLE : ABSENT;
    sender->since_us = clock_us();
}

void begin(RadioSender *sender, const Payload *payload, uint32_t now_us) {
    // The clock's low bits at an event differ from board to board: they seed the pauses.
    sender->random ^= static_cast<uint16_t>(now_us);
    if (sender->random == 0) {
        sender->random = 1;
    }
    sender->rounds = 1;
    sender->state = SENDING;
    sender->since_us = now_us;
    radio_send(payload->bytes, payload->size, draw(sender));
}

void follow(RadioSender *sender, uint32_t now_us) {
    const RadioTiming timing = radio_timing();
    const RadioProgress progress = radio_progress();
    if (progress == RADIO_PENDING) {
        if (clock_passed(now_us, sender->since_us + timing.lost_us)) {
            count_lost(sender);
            sender->state = ABSENT;
        }
        return;
    }
    sender->retries = static_cast<uint16_t>(sender->retries + radio_retries());
    if (progress == RADIO_SENT) {
        payload_queue_pop(&sender->queue);
        radio_stop_sending();
        sender->acknowledged = true;
        sender->state = IDLE;
    } else if (sender->rounds < timing.rounds) {
        // The more rounds have failed, the more nodes there may be that want the air.
        const uint8_t steps = static_cast<uint8_t>((sender->random >> 8) % (sender->rounds / 2U + timing.least_steps));
        ++sender->rounds;
        sender->since_us = now_us + static_cast<uint32_t>(steps) * timing.round_step_us;
        sender->state = PAUSING;
    } else {
        count_lost(sender);
        if (!radio_usable(radio_check())) {
            sender->state = ABSENT;
        }
    }
}

void resume(RadioSender *sender, uint32_t now_us) {
    if (clock_passed(now_us, sender->since_us)) {
        sender->state = SENDING;
        sender->since_us = now_us;
        radio_send_again(draw(sender));
    }
}

}  // namespace

void radio_sender_start(RadioSender *sender) {
    const SettingsBlock &settings = stored_settings();
    memset(sender, 0, sizeof *sender);
    sender->vehicle_node = wire_vehicle_node(settings.vehicle_id, settings.node_id);
    sender->random = static_cast<uint16_t>(sender->vehicle_node * 0x0101U);
    set_up(sender);
}

void radio_sender_push(RadioSender *sender, uint8_t kind, uint32_t node_time_us, void *payload,
                       uint8_t size) {
    const WireHeader header = {wire_version_kind(kind), sender->vehicle_node, sender->sequence++,
                               node_time_us};
    memcpy(payload, &header, sizeof header);
    const uint16_t dropped = sender->queue.dropped;
    const bool sending = sender->state == SENDING || sender->state == PAUSING;
    payload_queue_push(&sender->queue, payload, size, sending);
    sender->failed = static_cast<uint16_t>(sender->failed + (sender->queue.dropped - dropped));
}

void radio_sender_poll(RadioSender *sender, uint32_t now_us) {
    if (sender->state == SENDING) {
        follow(sender, now_us);
    }
    if (sender->state == PAUSING) {
        resume(sender, now_us);
    }
    if (sender->state == ABSENT && clock_passed(now_us, sender->since_us + SET_UP_EVERY_US)) {
        set_up(sender);
    }
    const Payload *payload = payload_queue_front(&sender->queue);
    if (sender->state == IDLE && payload != nullptr) {
        begin(sender, payload, now_us);
    }
}

LedCode radio_sender_led(const RadioSender *sender) {
    if (sender->state == ABSENT) {
        return LED_NO_RADIO;
    }
    return sender->acknowledged ? LED_OFF : LED_NO_LINK;
}
