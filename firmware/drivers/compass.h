// SPDX-License-Identifier: Apache-2.0
// The compass, reached through the IMU's bypass: HMC5883L, QMC5883L or QMC5883P and relatives.
#pragma once

#include <stdint.h>

#include "common/compass_chip.h"

// Looks for each chip in turn and sets the first one up. Null if there is none.
const CompassChip *compass_set_up();
