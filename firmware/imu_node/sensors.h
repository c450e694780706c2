// SPDX-License-Identifier: Apache-2.0
// The three sensors of a GY-87 on one bus: which may use it when, and which are present.
//
// One transfer runs at a time. The IMU's goes first, since its registers hold a reading for
// one period only; magnetometer and barometer fill the gaps. A sensor that fails three times in a
// row, lost its set-up, or is an IMU whose interrupt stays away, counts as absent and is set up
// again every 0.2 s.
#pragma once

#include <stdint.h>

#include "common/imu_reducer.h"
#include "drivers/barometer.h"
#include "drivers/compass.h"
#include "drivers/imu.h"

enum SensorIndex : uint8_t { SENSOR_IMU, SENSOR_MAG, SENSOR_BARO, SENSOR_COUNT };

struct SensorState {
    bool answering;
    bool seen;  // since the start
    uint8_t failures;
    uint32_t retry_us;  // while the IMU answers: when it counts as silent
};

struct Sensors {
    uint8_t job;
    bool baro_converting;
    bool self_test_failed;
    bool imu_silent;  // set up, but without an interrupt since
    uint8_t imu_id;   // WHO_AM_I
    SensorState states[SENSOR_COUNT];
    uint32_t imu_taken_us;  // interrupt time of the reading last taken
    uint32_t mag_due_us;
    uint32_t baro_due_us;
    uint32_t baro_began_us;  // the conversion now running
    const CompassChip *compass;
    uint8_t mag_address;  // of the compass found last
    Barometer barometer;
    uint8_t bytes[IMU_DATA_SIZE];  // the transfer now running
};
static_assert(IMU_DATA_SIZE >= COMPASS_SIZE_MAX && IMU_DATA_SIZE >= BAROMETER_RESULT_SIZE_MAX,
              "Sensors::bytes holds every transfer");

// What a call of sensors_poll brought, one bit each.
enum SensorNews : uint8_t {
    SENSOR_NEWS_IMU = 1 << 0,
    SENSOR_NEWS_MAG = 1 << 1,
    SENSOR_NEWS_BARO = 1 << 2,
};

struct SensorReadings {
    uint32_t imu_us;
    ImuReading imu;
    int16_t mag[3];
    uint32_t baro_us;
    BarometerReading baro;
};

// Finds and sets up the sensors; with the self-test if the board started cold.
void sensors_start(Sensors *sensors, bool self_test);

// To be called at every event; returns SensorNews and fills in the new readings.
uint8_t sensors_poll(Sensors *sensors, uint32_t now_us, SensorReadings *readings);

// WireSensor bits.
uint8_t sensors_present(const Sensors *sensors);
uint8_t sensors_failed(const Sensors *sensors);

// The chips found last, whether they answer now or not.
WireChips sensors_chips(const Sensors *sensors);
