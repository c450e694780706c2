// SPDX-License-Identifier: Apache-2.0
#include "drivers/bmp180.h"

#include "hal/twi.h"

namespace {

constexpr uint8_t CALIBRATION = 0xAA;
constexpr uint8_t CHIP_ID = 0xD0;
constexpr uint8_t CHIP_ID_VALUE = 0x55;

}  // namespace

bool bmp180_set_up(Bmp180Words *words) {
    uint8_t id = 0;
    if (!twi_run(BMP180_ADDRESS, &CHIP_ID, 1, &id, 1) || id != CHIP_ID_VALUE) {
        return false;
    }
    uint8_t bytes[BMP180_WORDS_SIZE];
    return twi_run(BMP180_ADDRESS, &CALIBRATION, 1, bytes, sizeof bytes) &&
           bmp180_read_words(bytes, words);
}
