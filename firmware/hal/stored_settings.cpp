// SPDX-License-Identifier: Apache-2.0
#include "hal/stored_settings.h"

#include <avr/pgmspace.h>

#include "hal/board.h"
#include "hal/clock.h"
#include "hal/events.h"
#include "hal/led.h"

namespace {

SettingsBlock block;

}  // namespace

void stored_settings_load(const SettingsImage *image) {
    memcpy_P(&block, image, sizeof block);
    while (!settings_valid(block)) {
        events_wait();
        board_feed_watchdog();
        led_blink(LED_SETTINGS_DAMAGED, clock_us());
    }
    if (block.soft_restart != 0) {
        board_restart_softly();
    }
}

const SettingsBlock &stored_settings() { return block; }
