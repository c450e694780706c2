// SPDX-License-Identifier: Apache-2.0
// The GPS node: GPS receiver to radio.
#include "common/wire.h"
#include "drivers/gps.h"
#include "drivers/radio.h"
#include "hal/board.h"
#include "hal/clock.h"
#include "hal/stored_settings.h"
#include "node/node_report.h"
#include "node/radio_sender.h"
#include "settings.h"

namespace {

const SettingsImage IMAGE SETTINGS_IN_FLASH =
    settings_image(default_settings(PROGRAM_GPS_NODE, GPS_NODE_ID, GPS_RADIO_PIPE));

Gps gps;
RadioSender sender;
NodeReport report;

void send_solution() {
    radio_sender_push(&sender, WIRE_GPS_QUALITY, gps.solution_us, &gps.quality, sizeof gps.quality);
    radio_sender_push(&sender, WIRE_GPS_FIX, gps.solution_us, &gps.fix, sizeof gps.fix);
    ++report.samples;
}

NodeHealth health() {
    const uint8_t present = gps.seen ? WIRE_SENSOR_GPS : 0;
    const uint8_t failed = gps_running(&gps) ? 0 : WIRE_SENSOR_GPS;
    return NodeHealth{present, failed, gps_errors(&gps), gps_chips(&gps)};
}

}  // namespace

int main() {
    radio_start_pins();
    board_start();
    stored_settings_load(&IMAGE);
    gps_start(&gps);
    radio_sender_start(&sender);
    report.due_us = report.loop_began_us = clock_us();
    for (;;) {
        const uint32_t now_us = node_report_wait(&report);
        if (gps_poll(&gps)) {
            send_solution();
        }
        if (node_report_due(&report, now_us)) {
            node_report_send(&report, now_us, health(), &sender);
        }
        radio_sender_poll(&sender, now_us);
        node_report_led(now_us, !gps_running(&gps), &sender);
    }
}
