// SPDX-License-Identifier: Apache-2.0
// The IMU node: the sensors of a GY-87 to radio.
#include <string.h>

#include "common/filters.h"
#include "common/imu_chip.h"
#include "common/imu_increments.h"
#include "common/imu_reducer.h"
#include "common/wire.h"
#include "drivers/radio.h"
#include "hal/board.h"
#include "hal/clock.h"
#include "hal/stored_settings.h"
#include "hal/twi.h"
#include "imu_node/sensors.h"
#include "node/node_report.h"
#include "node/radio_sender.h"
#include "settings.h"

namespace {

const SettingsImage IMAGE SETTINGS_IN_FLASH =
    settings_image(default_settings(PROGRAM_IMU_NODE, IMU_NODE_ID, IMU_RADIO_PIPE));

constexpr uint32_t GYRO_HIGHPASS_GAIN_1_HZ = high_pass_gain(GYRO_HIGHPASS_HZ, 1.0);

constexpr LowPassDesign ACCEL_LOWPASS = low_pass_design(ACCEL_LOWPASS_HZ, IMU_SAMPLE_HZ);

Sensors sensors;
SensorReadings readings;
ImuReducer reducer;        // of a fast radio
ImuIncrements increments;  // of a slow one
WireImu imu;
RadioSender sender;
NodeReport report;
bool mag_is_new;

// A value, not a variable: so the compiler folds the filters' constants into their code.
ImuReducerSettings reducer_settings() {
    const SettingsBlock &settings = stored_settings();
    return ImuReducerSettings{IMU_SAMPLE_HZ, settings.imu_send_hz, settings.imu_raw != 0, ACCEL_LOWPASS,
                              GYRO_HIGHPASS_GAIN_1_HZ / settings.imu_send_hz};
}

constexpr int16_t INCREMENT_SCALE_250_DPS = increment_scale(250.0, IMU_SAMPLE_HZ);

bool reduce() {
    if (!RADIO_SX1276) {
        return imu_reduce(&reducer, reducer_settings(), readings.imu, &imu);
    }
    const SettingsBlock &settings = stored_settings();
    const int16_t scale = static_cast<int16_t>(INCREMENT_SCALE_250_DPS << settings.gyro_range);
    return imu_increment(&increments, {IMU_SAMPLE_HZ, settings.imu_send_hz, scale}, readings.imu, &imu);
}

uint16_t flag_if(bool condition, uint16_t flag) { return condition ? flag : 0; }

uint16_t sensor_flags() {
    return flag_if(mag_is_new, WIRE_MAG_NEW) |
           flag_if(!sensors.states[SENSOR_MAG].answering, WIRE_MAG_ABSENT) |
           flag_if(!sensors.states[SENSOR_BARO].answering, WIRE_BARO_ABSENT) |
           flag_if(sensors.self_test_failed, WIRE_SELF_TEST_FAILED);
}

void send_imu() {
    for (uint8_t axis = 0; axis < 3; ++axis) {
        imu.mag[axis] = readings.mag[axis];
    }
    imu.temperature = imu_temperature(imu_family(sensors.imu_id), imu.temperature);
    imu.flags |= sensor_flags();
    const SettingsBlock &settings = stored_settings();
    imu.ranges = wire_ranges(settings.accel_range, settings.gyro_range,
                             sensors.compass != nullptr ? sensors.compass->scale : MAG_GAIN);
    mag_is_new = false;
    ++report.samples;
    radio_sender_push(&sender, WIRE_IMU, readings.imu_us, &imu, sizeof imu);
}

void send_baro() {
    WireBaro baro = {};
    baro.pressure_centipa = readings.baro.pressure_centipa;
    baro.temperature_ddegc = readings.baro.temperature_ddegc;
    radio_sender_push(&sender, WIRE_BARO, readings.baro_us, &baro, sizeof baro);
}

void poll_sensors(uint32_t now_us) {
    const uint8_t news = sensors_poll(&sensors, now_us, &readings);
    if ((news & SENSOR_NEWS_MAG) != 0) {
        mag_is_new = true;
    }
    if ((news & SENSOR_NEWS_IMU) != 0 && reduce()) {
        send_imu();
    }
    if ((news & SENSOR_NEWS_BARO) != 0) {
        send_baro();
    }
}

NodeHealth health() {
    return NodeHealth{sensors_present(&sensors), sensors_failed(&sensors), twi_errors(), sensors_chips(&sensors)};
}

}  // namespace

int main() {
    radio_start_pins();
    board_start();
    stored_settings_load(&IMAGE);
    radio_sender_start(&sender);
    sensors_start(&sensors, board_started_cold());
    report.due_us = report.loop_began_us = clock_us();
    for (;;) {
        const uint32_t now_us = node_report_wait(&report);
        poll_sensors(now_us);
        if (node_report_due(&report, now_us)) {
            node_report_send(&report, now_us, health(), &sender);
        }
        radio_sender_poll(&sender, now_us);
        node_report_led(now_us, sensors_failed(&sensors), &sender);
    }
}
