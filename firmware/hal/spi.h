// SPDX-License-Identifier: Apache-2.0
// SPI master at half the CPU's clock, and the radio's two control pins: D9 (CE), D10 (CSN).
#pragma once

#include <stdint.h>

void spi_start();
void spi_select_radio(bool selected);
void spi_enable_radio(bool enabled);
uint8_t spi_transfer(uint8_t byte);

// Level of the clock line, which the LED hangs on, while the radio is not selected.
void spi_set_idle_clock(bool high);
