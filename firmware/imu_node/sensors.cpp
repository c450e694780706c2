// SPDX-License-Identifier: Apache-2.0
#include "imu_node/sensors.h"

#include <string.h>

#include "common/wire.h"
#include "hal/clock.h"
#include "hal/lines.h"
#include "hal/twi.h"
#include "settings.h"

namespace {

enum Job : uint8_t { NO_JOB, IMU_READ, MAG_READ, BARO_COMMAND, BARO_READ };

constexpr uint8_t FAILURES_TO_ABSENT = 3;
constexpr uint32_t RETRY_US = 200000;
constexpr uint32_t IMU_SILENT_US = 50000;
constexpr uint32_t MAG_EVERY_US = 1000000UL / MAG_HZ;
constexpr uint32_t BARO_EVERY_US = 1000000UL / BARO_HZ;

bool set_up(Sensors *sensors, uint8_t index) {
    switch (index) {
        case SENSOR_IMU:
            return imu_set_up(&sensors->imu_id);
        case SENSOR_MAG:
            sensors->mag_due_us = clock_us();
            sensors->compass = compass_set_up();
            if (sensors->compass == nullptr) {
                return false;
            }
            sensors->mag_address = sensors->compass->address;
            return true;
        default:
            sensors->baro_converting = false;
            sensors->baro_due_us = clock_us();
            return barometer_set_up(&sensors->barometer);
    }
}

void try_set_up(Sensors *sensors, uint8_t index) {
    SensorState *state = &sensors->states[index];
    state->answering = set_up(sensors, index);
    state->seen = state->seen || state->answering;
    state->failures = 0;
    state->retry_us = clock_us() + RETRY_US;
}

void retry_absent(Sensors *sensors, uint32_t now_us) {
    for (uint8_t index = 0; index < SENSOR_COUNT; ++index) {
        const SensorState *state = &sensors->states[index];
        if (!state->answering && clock_passed(now_us, state->retry_us)) {
            try_set_up(sensors, index);
            if (index == SENSOR_IMU) {
                sensors->imu_taken_us = lines_imu_us();
            }
        }
    }
}

void note(SensorState *state, bool ok) {
    state->failures = ok ? 0 : static_cast<uint8_t>(state->failures + 1);
    if (state->failures >= FAILURES_TO_ABSENT) {
        state->answering = false;
        state->retry_us = clock_us() + RETRY_US;
    }
}

void read(Sensors *sensors, Job job, uint8_t address, uint8_t from, uint8_t size) {
    sensors->job = job;
    twi_begin(address, &from, 1, sensors->bytes, size);
}

void begin_baro(Sensors *sensors) {
    const Barometer *barometer = &sensors->barometer;
    if (sensors->baro_converting) {
        read(sensors, BARO_READ, barometer->address, barometer_result_from(barometer),
             barometer_result_size(barometer));
        return;
    }
    const uint8_t bytes[2] = {BAROMETER_CONTROL, barometer_command(barometer)};
    sensors->job = BARO_COMMAND;
    twi_begin(barometer->address, bytes, sizeof bytes, nullptr, 0);
}

// The conversion's time counts from the end of the command.
void baro_commanded(Sensors *sensors) {
    sensors->baro_converting = true;
    sensors->baro_began_us = clock_us();
    sensors->baro_due_us = sensors->baro_began_us + barometer_conversion_us(&sensors->barometer);
}

// The reading is that of the conversion's middle. A temperature alone is followed by its pressure.
BarometerResult baro_read(Sensors *sensors, SensorReadings *readings) {
    const uint16_t conversion_us = barometer_conversion_us(&sensors->barometer);
    const BarometerResult result = barometer_take(&sensors->barometer, sensors->bytes, &readings->baro);
    sensors->baro_converting = false;
    if (result == BAROMETER_PRESSURE) {
        readings->baro_us = sensors->baro_began_us + conversion_us / 2;
        sensors->baro_due_us = sensors->baro_began_us + BARO_EVERY_US;
    }
    return result;
}

uint8_t end_baro(Sensors *sensors, bool ok, SensorReadings *readings) {
    BarometerResult result = ok ? BAROMETER_TEMPERATURE : BAROMETER_BAD;
    if (ok && sensors->job == BARO_COMMAND) {
        baro_commanded(sensors);
    } else if (ok) {
        result = baro_read(sensors, readings);
    }
    note(&sensors->states[SENSOR_BARO], result != BAROMETER_BAD);
    if (result == BAROMETER_BAD) {
        sensors->baro_converting = false;
        sensors->baro_due_us = clock_us() + BARO_EVERY_US;
    }
    return result == BAROMETER_PRESSURE ? SENSOR_NEWS_BARO : 0;
}

uint8_t end_job(Sensors *sensors, bool ok, SensorReadings *readings) {
    switch (sensors->job) {
        case IMU_READ:
            ok = ok && imu_read_bytes(sensors->bytes, &readings->imu);
            note(&sensors->states[SENSOR_IMU], ok);
            readings->imu_us = sensors->imu_taken_us;
            return ok ? SENSOR_NEWS_IMU : 0;
        case MAG_READ:
            ok = ok && compass_read_bytes(*sensors->compass, sensors->bytes, readings->mag);
            note(&sensors->states[SENSOR_MAG], ok);
            return ok ? SENSOR_NEWS_MAG : 0;
        default:
            return end_baro(sensors, ok, readings);
    }
}

void watch_imu(Sensors *sensors, uint32_t now_us) {
    SensorState *imu = &sensors->states[SENSOR_IMU];
    if (imu->answering && clock_passed(now_us, imu->retry_us)) {
        imu->answering = false;
        sensors->imu_silent = true;
    }
}

void begin_job(Sensors *sensors, uint32_t now_us) {
    const uint32_t imu_us = lines_imu_us();
    if (sensors->states[SENSOR_IMU].answering && imu_us != sensors->imu_taken_us) {
        sensors->imu_taken_us = imu_us;
        sensors->imu_silent = false;
        sensors->states[SENSOR_IMU].retry_us = imu_us + IMU_SILENT_US;
        read(sensors, IMU_READ, IMU_ADDRESS, IMU_DATA, IMU_DATA_SIZE);
    } else if (sensors->states[SENSOR_MAG].answering && clock_passed(now_us, sensors->mag_due_us)) {
        sensors->mag_due_us += MAG_EVERY_US;
        if (clock_passed(now_us, sensors->mag_due_us)) {
            sensors->mag_due_us = now_us + MAG_EVERY_US;  // it was away: do not catch up
        }
        read(sensors, MAG_READ, sensors->compass->address, sensors->compass->from, sensors->compass->size);
    } else if (sensors->states[SENSOR_BARO].answering && clock_passed(now_us, sensors->baro_due_us)) {
        begin_baro(sensors);
    } else {
        watch_imu(sensors, now_us);
    }
}

}  // namespace

void sensors_start(Sensors *sensors, bool self_test) {
    memset(sensors, 0, sizeof *sensors);
    twi_start();
    if (self_test) {
        imu_reset();
        sensors->self_test_failed =
            imu_set_up(&sensors->imu_id) && !imu_self_test(sensors->imu_id);
    }
    // The IMU once more: a test that broke off may have left its ranges behind.
    for (uint8_t index = 0; index < SENSOR_COUNT; ++index) {
        try_set_up(sensors, index);
    }
    lines_start_imu();
    sensors->imu_taken_us = lines_imu_us();
}

uint8_t sensors_poll(Sensors *sensors, uint32_t now_us, SensorReadings *readings) {
    uint8_t news = 0;
    if (sensors->job != NO_JOB) {
        const TwiState state = twi_poll(now_us);
        if (state == TWI_BUSY) {
            return 0;
        }
        news = end_job(sensors, state == TWI_DONE, readings);
        sensors->job = NO_JOB;
    }
    retry_absent(sensors, now_us);
    begin_job(sensors, now_us);
    return news;
}

uint8_t sensors_present(const Sensors *sensors) {
    uint8_t bits = 0;
    for (uint8_t index = 0; index < SENSOR_COUNT; ++index) {
        bits = static_cast<uint8_t>(bits | (sensors->states[index].seen ? 1 << index : 0));
    }
    return bits;
}

uint8_t sensors_failed(const Sensors *sensors) {
    uint8_t bits = sensors->self_test_failed || sensors->imu_silent ? WIRE_SENSOR_IMU : 0;
    for (uint8_t index = 0; index < SENSOR_COUNT; ++index) {
        bits = static_cast<uint8_t>(bits | (sensors->states[index].answering ? 0 : 1 << index));
    }
    return bits;
}

WireChips sensors_chips(const Sensors *sensors) {
    const SensorState *states = sensors->states;
    WireChips chips = {};
    chips.imu = states[SENSOR_IMU].seen ? sensors->imu_id : 0;
    chips.magnetometer = sensors->mag_address;
    chips.barometer = states[SENSOR_BARO].seen ? sensors->barometer.id : 0;
    return chips;
}
