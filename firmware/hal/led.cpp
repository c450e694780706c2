// SPDX-License-Identifier: Apache-2.0
#include "hal/led.h"

#include "hal/spi.h"

void led_blink(LedCode code, uint32_t now_us) {
    const uint8_t slot = static_cast<uint8_t>(now_us >> 17) & 0x0F;  // 131 ms each
    spi_set_idle_clock(slot % 2 == 0 && slot / 2 < code);
}
