// SPDX-License-Identifier: Apache-2.0
#include "drivers/barometer.h"

#include "hal/twi.h"

namespace {

constexpr uint8_t CHIP_ID = 0xD0;
constexpr uint8_t ID_BMP180 = 0x55;
constexpr uint8_t ID_BMP280 = 0x58;
constexpr uint8_t ID_BMP280_SAMPLE_1 = 0x56;
constexpr uint8_t ID_BMP280_SAMPLE_2 = 0x57;
constexpr uint8_t ID_BME280 = 0x60;
constexpr uint8_t ADDRESS = 0x77;
constexpr uint8_t OTHER_ADDRESS = 0x76;  // not of the BMP180

constexpr uint8_t BMP180_CALIBRATION = 0xAA;
constexpr uint8_t BMP180_RESULT = 0xF6;
constexpr uint8_t BMP180_TEMPERATURE = 0x2E;
constexpr uint8_t BMP180_PRESSURE = 0x34 | BARO_OVERSAMPLING << 6;
constexpr uint16_t BMP180_TEMPERATURE_US = 4500;
// Section 3.3.1.
constexpr uint16_t BMP180_PRESSURE_US = BARO_OVERSAMPLING == 0   ? 4500
                                        : BARO_OVERSAMPLING == 1 ? 7500
                                        : BARO_OVERSAMPLING == 2 ? 13500
                                                                 : 25500;
constexpr uint8_t BMP180_PRESSURES_PER_TEMPERATURE = BARO_HZ;

constexpr uint8_t BMP280_CALIBRATION = 0x88;
constexpr uint8_t BMP280_CONFIG = 0xF5;
constexpr uint8_t BMP280_RESULT = 0xF7;
// Temperature once, pressure 1, 2, 4 or 8 times; forced mode: one measurement, then asleep.
constexpr uint8_t BMP280_FORCED = 1 << 5 | (BARO_OVERSAMPLING + 1) << 2 | 1;
// Appendix 9.1 of the BME280's datasheet: the longest times.
constexpr uint16_t BMP280_US = 1250 + 2300 + (2300 << BARO_OVERSAMPLING) + 575;

static_assert(barometer_longest_us() >= BMP180_PRESSURE_US && barometer_longest_us() >= BMP280_US,
              "barometer_longest_us");
static_assert(1000000UL / BARO_HZ > barometer_longest_us() + BMP180_TEMPERATURE_US + 1000,
              "BARO_HZ is too high for BARO_OVERSAMPLING");

bool is_bmp180(const Barometer *barometer) { return barometer->id == ID_BMP180; }

bool temperature_next(const Barometer *barometer) {
    return is_bmp180(barometer) && barometer->cycle == 0;
}

bool read_registers(uint8_t address, uint8_t from, uint8_t *bytes, uint8_t size) {
    return twi_run(address, &from, 1, bytes, size);
}

bool set_up_bmp180(Barometer *barometer) {
    uint8_t bytes[BMP180_WORDS_SIZE];
    return read_registers(barometer->address, BMP180_CALIBRATION, bytes, sizeof bytes) &&
           bmp180_read_words(bytes, &barometer->words.bmp180);
}

bool set_up_bmp280(Barometer *barometer) {
    uint8_t bytes[BMP280_WORDS_SIZE];
    const uint8_t no_filter[2] = {BMP280_CONFIG, 0};
    return twi_run(barometer->address, no_filter, sizeof no_filter, nullptr, 0) &&
           read_registers(barometer->address, BMP280_CALIBRATION, bytes, sizeof bytes) &&
           bmp280_read_words(bytes, &barometer->words.bmp280);
}

bool set_up_at(Barometer *barometer, uint8_t address) {
    barometer->address = address;
    barometer->cycle = 0;
    if (!twi_answers(address) || !read_registers(address, CHIP_ID, &barometer->id, 1)) {
        return false;
    }
    switch (barometer->id) {
        case ID_BMP180:
            return set_up_bmp180(barometer);
        case ID_BMP280:
        case ID_BMP280_SAMPLE_1:
        case ID_BMP280_SAMPLE_2:
        case ID_BME280:
            return set_up_bmp280(barometer);
        default:
            return false;
    }
}

BarometerResult take_bmp180(Barometer *barometer, const uint8_t *bytes, BarometerReading *reading) {
    const Bmp180Words *words = &barometer->words.bmp180;
    const uint16_t high = static_cast<uint16_t>(bytes[0] << 8 | bytes[1]);
    const bool temperature = temperature_next(barometer);
    barometer->cycle =
        static_cast<uint8_t>((barometer->cycle + 1) % (BMP180_PRESSURES_PER_TEMPERATURE + 1));
    if (temperature) {
        barometer->b5 = bmp180_b5(words, high);
        return BAROMETER_TEMPERATURE;
    }
    const uint32_t raw = (static_cast<uint32_t>(high) << 8 | bytes[2]) >> (8 - BARO_OVERSAMPLING);
    reading->pressure_centipa = bmp180_pressure_centipa(words, barometer->b5, raw, BARO_OVERSAMPLING);
    reading->temperature_ddegc = bmp180_temperature_ddegc(barometer->b5);
    return BAROMETER_PRESSURE;
}

BarometerResult take_bmp280(const Bmp280Words *words, const uint8_t *bytes, BarometerReading *reading) {
    uint32_t raw_pressure;
    uint32_t raw_temperature;
    if (!bmp280_read_raw(bytes, &raw_pressure, &raw_temperature)) {
        return BAROMETER_BAD;
    }
    const int32_t t_fine = bmp280_t_fine(words, raw_temperature);
    reading->pressure_centipa = bmp280_pressure_centipa(words, t_fine, raw_pressure);
    reading->temperature_ddegc = bmp280_temperature_ddegc(t_fine);
    return BAROMETER_PRESSURE;
}

}  // namespace

bool barometer_set_up(Barometer *barometer) {
    return set_up_at(barometer, ADDRESS) || set_up_at(barometer, OTHER_ADDRESS);
}

uint8_t barometer_command(const Barometer *barometer) {
    if (!is_bmp180(barometer)) {
        return BMP280_FORCED;
    }
    return temperature_next(barometer) ? BMP180_TEMPERATURE : BMP180_PRESSURE;
}

uint16_t barometer_conversion_us(const Barometer *barometer) {
    if (!is_bmp180(barometer)) {
        return BMP280_US;
    }
    return temperature_next(barometer) ? BMP180_TEMPERATURE_US : BMP180_PRESSURE_US;
}

uint8_t barometer_result_from(const Barometer *barometer) {
    return is_bmp180(barometer) ? BMP180_RESULT : BMP280_RESULT;
}

uint8_t barometer_result_size(const Barometer *barometer) {
    if (!is_bmp180(barometer)) {
        return BAROMETER_RESULT_SIZE_MAX;
    }
    return temperature_next(barometer) ? 2 : 3;
}

BarometerResult barometer_take(Barometer *barometer, const uint8_t *bytes, BarometerReading *reading) {
    return is_bmp180(barometer) ? take_bmp180(barometer, bytes, reading)
                                : take_bmp280(&barometer->words.bmp280, bytes, reading);
}
