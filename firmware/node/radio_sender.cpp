// SPDX-License-Identifier: Apache-2.0
#include "node/radio_sender.h"

#include <string.h>

#include "common/random16.h"
#include "drivers/nrf24.h"
#include "hal/clock.h"
#include "hal/lines.h"
#include "hal/stored_settings.h"

namespace {

enum State : uint8_t { ABSENT, IDLE, SENDING, PAUSING };

// One retry by the chip alone, then a new round: 24 attempts in all.
constexpr uint8_t RETRIES = 1;
constexpr uint8_t ROUNDS = 12;
// Pauses in units of 250 us. The steps are longer than a full packet with its acknowledgement (0.33,
// 0.53 and 1.74 ms), so that two different draws keep clear of each other; the shortest waits for
// the acknowledgement (section 7.4.2 of the chip's specification).
struct Pauses {
    uint8_t step;
    uint8_t count;
    uint16_t round_step_us;
};
constexpr Pauses PAUSES_250 = {7, 3, 2000};
constexpr Pauses PAUSES_1000 = {3, 5, 1000};
constexpr Pauses PAUSES_2000 = {2, 5, 1000};
constexpr uint8_t PAUSE_FIRST = 2;
constexpr bool fits(const Pauses &pauses) {
    return PAUSE_FIRST + pauses.step * (pauses.count - 1) <= 16;
}
static_assert(fits(PAUSES_250) && fits(PAUSES_1000) && fits(PAUSES_2000),
              "the chip pauses up to 4 ms");

constexpr uint32_t LOST_US = 50000;
constexpr uint32_t SET_UP_EVERY_US = 500000;

const Pauses &pauses() {
    const uint16_t kbps = stored_settings().radio_kbps;
    return kbps == 250 ? PAUSES_250 : kbps == 1000 ? PAUSES_1000 : PAUSES_2000;
}

uint8_t draw_pause(RadioSender *sender) {
    sender->random = random16_next(sender->random);
    const Pauses &drawn = pauses();
    return static_cast<uint8_t>(PAUSE_FIRST + drawn.step * ((sender->random >> 4) % drawn.count));
}

void count_lost(RadioSender *sender) {
    ++sender->failed;
    sender->acknowledged = false;
    payload_queue_pop(&sender->queue);
    nrf24_stop_sending();
    sender->state = IDLE;
}

void set_up(RadioSender *sender) {
    sender->radio = nrf24_start_sender(stored_settings().radio_pipe);
    sender->state = nrf24_usable(sender->radio) ? IDLE : ABSENT;
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
    nrf24_send(payload->bytes, payload->size, draw_pause(sender), RETRIES);
}

void follow(RadioSender *sender, uint32_t now_us) {
    if (!lines_radio_low()) {
        if (clock_passed(now_us, sender->since_us + LOST_US)) {
            count_lost(sender);
            sender->state = ABSENT;
        }
        return;
    }
    const uint8_t causes = nrf24_take_causes();
    sender->retries = static_cast<uint16_t>(sender->retries + nrf24_retries());
    if ((causes & NRF24_SENT) != 0) {
        payload_queue_pop(&sender->queue);
        nrf24_stop_sending();
        sender->acknowledged = true;
        sender->state = IDLE;
    } else if ((causes & NRF24_GAVE_UP) != 0 && sender->rounds < ROUNDS) {
        // The more rounds have failed, the more nodes there may be that want the air.
        const uint8_t steps = static_cast<uint8_t>((sender->random >> 8) % (sender->rounds / 2 + 1U));
        ++sender->rounds;
        sender->since_us = now_us + steps * pauses().round_step_us;
        sender->state = PAUSING;
    } else {
        count_lost(sender);
        if (!nrf24_usable(nrf24_check())) {
            sender->state = ABSENT;
        }
    }
}

void resume(RadioSender *sender, uint32_t now_us) {
    if (clock_passed(now_us, sender->since_us)) {
        sender->state = SENDING;
        sender->since_us = now_us;
        nrf24_send_again(draw_pause(sender), RETRIES);
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
