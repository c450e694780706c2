// SPDX-License-Identifier: Apache-2.0
// The two interrupt lines: D2 (INT0) from the IMU, rising; D3 (INT1) from the radio.
#pragma once

#include <stdint.h>

void lines_start_imu();
void lines_start_radio(bool active_high);

// When the line last moved.
uint32_t lines_imu_us();
uint32_t lines_radio_us();

// Whether the radio still holds its line active: an edge may be missed, a level not.
bool lines_radio_active();
