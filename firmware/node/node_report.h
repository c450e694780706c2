// SPDX-License-Identifier: Apache-2.0
// The once-a-second status that every node sends, and the watch over its loop.
#pragma once

#include <stdint.h>

#include "node/radio_sender.h"

struct NodeReport {
    uint32_t due_us;
    uint32_t loop_began_us;
    uint32_t loop_max_us;
    uint16_t samples;
};

struct NodeHealth {
    uint8_t sensors_present;
    uint8_t sensors_failed;
    uint16_t bus_errors;
    WireChips chips;
};

// Sleeps until the next event, feeds the watchdog and times the loop's waking part. Returns the
// time, which holds for this turn of the loop: asking the clock costs 70 cycles.
uint32_t node_report_wait(NodeReport *report);

// Whether a second has passed since the last status.
bool node_report_due(const NodeReport *report, uint32_t now_us);

void node_report_send(NodeReport *report, uint32_t now_us, const NodeHealth &health,
                      RadioSender *sender);

// Shows on the LED what is wrong, the radio before the sensors.
void node_report_led(uint32_t now_us, bool sensor_failed, const RadioSender *sender);
