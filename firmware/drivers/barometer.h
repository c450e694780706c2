// SPDX-License-Identifier: Apache-2.0
// The barometer: BMP180 (or BMP085), BMP280 or BME280. Datasheets BST-BMP180-DS000 revision 2.5,
// BST-BMP280-DS001 revision 1.14, BST-BME280-DS002 revision 1.6.
//
// All of them measure on a command to register 0xF4, and have the result some time later. The BMP180
// measures temperature and pressure apart, the temperature once a second; the others both at once.
#pragma once

#include <stdint.h>

#include "common/bmp180_math.h"
#include "common/bmp280_math.h"
#include "settings.h"

constexpr uint8_t BAROMETER_CONTROL = 0xF4;
constexpr uint8_t BAROMETER_RESULT_SIZE_MAX = 6;

struct Barometer {
    uint8_t address;
    uint8_t id;     // register 0xD0: 0x55, 0x58 (BMP280), 0x60 (BME280)
    uint8_t cycle;  // BMP180: 0 measures the temperature next, then so many pressures follow
    int32_t b5;
    union {
        Bmp180Words bmp180;
        Bmp280Words bmp280;
    } words;
};

struct BarometerReading {
    uint32_t pressure_centipa;
    int16_t temperature_ddegc;
};

enum BarometerResult : uint8_t { BAROMETER_BAD, BAROMETER_TEMPERATURE, BAROMETER_PRESSURE };

// The longest conversion that may be commanded.
constexpr uint32_t barometer_longest_us() {
    return BARO_OVERSAMPLING == 3 ? 25500 : BARO_OVERSAMPLING == 2 ? 13500 : 8725;
}

// Looks for each chip at each address and reads its calibration words.
bool barometer_set_up(Barometer *barometer);

// The next conversion: its command, the time it takes, and where its result is read.
uint8_t barometer_command(const Barometer *barometer);
uint16_t barometer_conversion_us(const Barometer *barometer);
uint8_t barometer_result_from(const Barometer *barometer);
uint8_t barometer_result_size(const Barometer *barometer);

// Takes the bytes of a result and goes on to the next conversion.
BarometerResult barometer_take(Barometer *barometer, const uint8_t *bytes, BarometerReading *reading);
