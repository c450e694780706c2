// SPDX-License-Identifier: Apache-2.0
#include "node/node_report.h"

#include "common/firmware_version.h"
#include "hal/board.h"
#include "hal/clock.h"
#include "hal/events.h"
#include "settings.h"

namespace {

constexpr uint8_t EVERY_S = RADIO_SX1276 ? 5 : 1;

}  // namespace

uint32_t node_report_wait(NodeReport *report) {
    const uint32_t loop_us = clock_us() - report->loop_began_us;
    if (loop_us > report->loop_max_us) {
        report->loop_max_us = loop_us;
    }
    events_wait();
    report->loop_began_us = clock_us();
    board_feed_watchdog();
    return report->loop_began_us;
}

bool node_report_due(const NodeReport *report, uint32_t now_us) {
    return clock_passed(now_us, report->due_us);
}

void node_report_send(NodeReport *report, uint32_t now_us, const NodeHealth &health,
                      RadioSender *sender) {
    report->due_us += EVERY_S * 1000000UL;
    WireNodeStatus status = {};
    status.version_major = FIRMWARE_VERSION_MAJOR;
    status.version_minor = FIRMWARE_VERSION_MINOR;
    status.reset_and_radio = wire_reset_and_radio(board_reset_cause(), sender->radio);
    status.sensors_present = health.sensors_present;
    status.sensors_failed = health.sensors_failed;
    status.bus_errors = health.bus_errors;
    status.radio_failed = sender->failed;
    status.radio_retries = sender->retries;
    status.loop_max_us = report->loop_max_us > UINT16_MAX
                             ? static_cast<uint16_t>(UINT16_MAX)
                             : static_cast<uint16_t>(report->loop_max_us);
    status.sample_rate_hz = (report->samples + EVERY_S / 2) / EVERY_S;
    status.supply_mv = board_supply_mv();
    status.chips = health.chips;
    report->loop_max_us = 0;
    report->samples = 0;
    radio_sender_push(sender, WIRE_NODE_STATUS, now_us, &status, sizeof status);
}

void node_report_led(uint32_t now_us, bool sensor_failed, const RadioSender *sender) {
    const LedCode radio = radio_sender_led(sender);
    led_blink(radio == LED_OFF && sensor_failed ? LED_NO_SENSOR : radio, now_us);
}
