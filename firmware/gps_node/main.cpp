// SPDX-License-Identifier: Apache-2.0
// The GPS node: u-blox M8N to radio.
#include "common/ubx.h"
#include "common/wire.h"
#include "drivers/ublox.h"
#include "hal/board.h"
#include "hal/clock.h"
#include "hal/lines.h"
#include "hal/spi.h"
#include "hal/stored_settings.h"
#include "hal/uart.h"
#include "node/node_report.h"
#include "node/radio_sender.h"
#include "settings.h"

namespace {

const SettingsImage IMAGE SETTINGS_IN_FLASH =
    settings_image(default_settings(PROGRAM_GPS_NODE, GPS_NODE_ID, GPS_RADIO_PIPE));

Ublox ublox;
RadioSender sender;
NodeReport report;

void send_solution() {
    WireGpsQuality quality;
    WireGpsFix fix;
    ubx_to_quality(ublox.reader.payload, &quality);
    ubx_to_fix(ublox.reader.payload, &fix);
    radio_sender_push(&sender, WIRE_GPS_QUALITY, ublox.message_us, &quality, sizeof quality);
    radio_sender_push(&sender, WIRE_GPS_FIX, ublox.message_us, &fix, sizeof fix);
    ++report.samples;
}

NodeHealth health() {
    constexpr uint8_t gps = WIRE_SENSOR_GPS;
    constexpr uint8_t none = 0;
    const uint16_t errors =
        static_cast<uint16_t>(uart_errors() + ublox.reader.errors + ublox.failures);
    return NodeHealth{ublox.seen ? gps : none, ublox_running(&ublox) ? none : gps, errors};
}

}  // namespace

int main() {
    spi_start();
    lines_start_radio();
    board_start();
    stored_settings_load(&IMAGE);
    ublox_start(&ublox);
    radio_sender_start(&sender);
    report.due_us = report.loop_began_us = clock_us();
    for (;;) {
        const uint32_t now_us = node_report_wait(&report);
        if (ublox_poll(&ublox)) {
            send_solution();
        }
        if (node_report_due(&report, now_us)) {
            node_report_send(&report, now_us, health(), &sender);
        }
        radio_sender_poll(&sender, now_us);
        node_report_led(now_us, !ublox_running(&ublox), &sender);
    }
}
