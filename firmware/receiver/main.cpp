// SPDX-License-Identifier: Apache-2.0
// The receiver: packets of six radio pipes become frames on the serial line.
#include <string.h>

#include "common/frame.h"
#include "common/link_counter.h"
#include "drivers/radio.h"
#include "hal/board.h"
#include "hal/clock.h"
#include "hal/events.h"
#include "hal/lines.h"
#include "hal/led.h"
#include "hal/stored_settings.h"
#include "hal/uart.h"
#include "settings.h"

namespace {

// Eleven of the longest radio frames: 10 ms of the line at 500 kbaud.
constexpr uint16_t TX_RING_SIZE = 512;

constexpr uint32_t STATUS_EVERY_US = 1000000;
constexpr uint32_t SET_UP_EVERY_US = 500000;
constexpr uint32_t QUIET_US = 2000000;
constexpr uint32_t NOISE_EVERY_US = 50000;
// The carrier detector needs 130 us to enter reception and 40 us to measure: section 6.4.
constexpr uint32_t NOISE_AFTER_US = 200;

const SettingsImage IMAGE SETTINGS_IN_FLASH =
    settings_image(default_settings(PROGRAM_RECEIVER, 0, 0));

enum NoiseState : uint8_t { NOISE_IDLE, NOISE_LISTENING, NOISE_HEARD };

struct Receiver {
    WireRadioState radio;
    NoiseState noise_state;
    uint8_t sequence;
    uint16_t dropped;
    uint16_t noise_looks;
    uint16_t noise_heard;
    uint32_t status_due_us;
    uint32_t set_up_due_us;
    uint32_t noise_due_us;
    uint32_t heard_us;  // the last packet
    LinkCounter link;
};

Receiver receiver;
uint8_t tx_ring[TX_RING_SIZE];

void send_frame(const void *content, uint8_t size) {
    uint8_t frame[FRAME_MAX_SIZE];
    const uint8_t frame_size = frame_encode(static_cast<const uint8_t *>(content), size, frame);
    if (!uart_write(frame, frame_size)) {
        ++receiver.dropped;
    }
}

void set_up_radio() {
    receiver.radio = radio_start_receiver();
    receiver.set_up_due_us = clock_us() + SET_UP_EVERY_US;
    receiver.noise_state = NOISE_IDLE;
    receiver.noise_due_us = clock_us() + NOISE_EVERY_US;
}

void pass_on(const RadioPacket &packet, uint32_t arrived_us) {
    receiver.heard_us = arrived_us;
    const bool is_foreign = packet.pipe == WIRE_NO_PIPE;
    if (!is_foreign) {
        link_count(&receiver.link, packet.pipe, packet.payload, packet.size);
        if (packet.fifo_full) {
            link_overrun(&receiver.link, packet.pipe);
        }
    }
    WireSignalFrame frame;
    const bool has_signal = packet.signal.minus_rssi_dbm != 0;
    const uint8_t kind = is_foreign ? WIRE_FOREIGN : has_signal ? WIRE_RADIO_SIGNAL : WIRE_RADIO;
    frame.header = WireFrameHeader{wire_version_kind(kind), receiver.sequence++, packet.pipe, arrived_us};
    uint8_t *end = reinterpret_cast<uint8_t *>(&frame) + sizeof frame.header;
    if (kind != WIRE_RADIO) {
        memcpy(end, &packet.signal, sizeof packet.signal);
        end += sizeof packet.signal;
    }
    memcpy(end, packet.payload, packet.size);
    send_frame(&frame, static_cast<uint8_t>(end - reinterpret_cast<uint8_t *>(&frame) + packet.size));
}

void poll_radio() {
    if (!radio_has_received()) {
        return;
    }
    receiver.noise_state = NOISE_IDLE;  // the carrier is a packet's own
    uint32_t arrived_us = lines_radio_us();
    RadioPacket packet;
    while (radio_receive(&packet)) {
        pass_on(packet, arrived_us);
        arrived_us = clock_us();  // whatever follows came while this one was read
    }
}

void end_noise_look(uint32_t now_us, bool heard) {
    ++receiver.noise_looks;
    receiver.noise_heard = static_cast<uint16_t>(receiver.noise_heard + (heard ? 1 : 0));
    receiver.noise_state = NOISE_IDLE;
    receiver.noise_due_us = now_us + NOISE_EVERY_US;
}

void poll_noise(uint32_t now_us) {
    if (!clock_passed(now_us, receiver.noise_due_us)) {
        return;
    }
    if (receiver.noise_state == NOISE_IDLE) {
        radio_measure_carrier();
        receiver.noise_state = NOISE_LISTENING;
        receiver.noise_due_us = now_us + NOISE_AFTER_US;
    } else if (receiver.noise_state == NOISE_LISTENING && radio_carrier()) {
        receiver.noise_state = NOISE_HEARD;
        receiver.noise_due_us = now_us + radio_longest_packet_us();
    } else {
        end_noise_look(now_us, receiver.noise_state == NOISE_HEARD);
    }
}

uint8_t take_noise_percent() {
    const uint16_t looks = receiver.noise_looks;
    const uint16_t heard = receiver.noise_heard;
    receiver.noise_looks = receiver.noise_heard = 0;
    return looks == 0 ? 0 : static_cast<uint8_t>(100UL * heard / looks);
}

void poll_status(uint32_t now_us) {
    if (!clock_passed(now_us, receiver.status_due_us)) {
        return;
    }
    receiver.status_due_us += STATUS_EVERY_US;
    WireReceiverStatus status;
    status.header = WireFrameHeader{wire_version_kind(WIRE_RECEIVER_STATUS), receiver.sequence++,
                                    WIRE_NO_PIPE, now_us};
    status.channel = RADIO_SX1276 ? WIRE_LORA_CHANNEL : stored_settings().radio_channel;
    status.noise_percent = take_noise_percent();
    status.dropped = receiver.dropped;
    status.reset_and_radio = wire_reset_and_radio(board_reset_cause(), receiver.radio);
    memcpy(status.pipes, receiver.link.pipes, sizeof status.pipes);
    send_frame(&status, sizeof status);
    if (radio_usable(receiver.radio)) {
        receiver.radio = radio_check();
        receiver.set_up_due_us = now_us;  // the last one may lie more than half a wrap back
    }
}

LedCode led_code(uint32_t now_us) {
    if (!radio_usable(receiver.radio)) {
        return LED_NO_RADIO;
    }
    if (clock_passed(now_us, receiver.heard_us + QUIET_US)) {
        receiver.heard_us = now_us - QUIET_US;  // or the wrap would make it look recent
        return LED_NO_LINK;
    }
    return LED_OFF;
}

}  // namespace

int main() {
    radio_start_pins();
    uart_start(UART_BAUD, tx_ring, sizeof tx_ring);
    board_start();
    stored_settings_load(&IMAGE);
    set_up_radio();
    receiver.status_due_us = clock_us() + STATUS_EVERY_US;
    for (;;) {
        events_wait();
        board_feed_watchdog();
        const uint32_t now_us = clock_us();
        if (radio_usable(receiver.radio)) {
            poll_radio();
            poll_noise(now_us);
        } else if (clock_passed(now_us, receiver.set_up_due_us)) {
            set_up_radio();
        }
        poll_status(now_us);
        led_blink(led_code(now_us), now_us);
    }
}
