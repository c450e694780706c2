// SPDX-License-Identifier: Apache-2.0
// The version of all three programs.
#pragma once

#include <stdint.h>

constexpr uint8_t FIRMWARE_VERSION_MAJOR = 1;
constexpr uint8_t FIRMWARE_VERSION_MINOR = 0;
