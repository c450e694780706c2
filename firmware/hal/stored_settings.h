// SPDX-License-Identifier: Apache-2.0
// The settings block of this board, read from flash at the start.
#pragma once

#include "common/settings_block.h"

// Each program defines its block once:
//     const SettingsImage IMAGE SETTINGS_IN_FLASH = settings_image(default_settings(...));
#define SETTINGS_IN_FLASH __attribute__((used, section(".progmem.gcc_settings")))

// Reads the block. One that is damaged never returns: the board blinks fast and stays off the air,
// where an invalid channel, address or vehicle would disturb others.
void stored_settings_load(const SettingsImage *image);

// Valid once loaded.
const SettingsBlock &stored_settings();
