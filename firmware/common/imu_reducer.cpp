// SPDX-License-Identifier: Apache-2.0
#include "common/imu_reducer.h"

namespace {

int16_t word(const uint8_t *bytes) { return static_cast<int16_t>(bytes[0] << 8 | bytes[1]); }

bool at_end(int16_t counts) { return counts == INT16_MAX || counts == INT16_MIN; }

void take(ImuReducer *reducer, const ImuReducerSettings &settings, const ImuReading &reading) {
    for (uint8_t axis = 0; axis < 3; ++axis) {
        const int16_t accel = reading.accel[axis];
        const int16_t gyro = reading.gyro[axis];
        if (settings.raw) {
            mean_add(&reducer->accel_mean[axis], accel);
        } else if (!reducer->started) {
            low_pass_start(&reducer->accel_lowpass[axis], accel);
        } else {
            low_pass_update(&reducer->accel_lowpass[axis], settings.accel_lowpass, accel);
        }
        mean_add(&reducer->gyro_mean[axis], gyro);
        if (at_end(accel)) {
            reducer->flags |= WIRE_ACCEL_CLIPPED;
        }
        if (at_end(gyro)) {
            reducer->flags |= WIRE_GYRO_CLIPPED;
        }
    }
    reducer->started = true;
}

void give(ImuReducer *reducer, const ImuReducerSettings &settings, WireImu *payload) {
    for (uint8_t axis = 0; axis < 3; ++axis) {
        const int16_t gyro = mean_take(&reducer->gyro_mean[axis]);
        if (settings.raw) {
            payload->accel[axis] = mean_take(&reducer->accel_mean[axis]);
            payload->gyro[axis] = gyro;
        } else {
            payload->accel[axis] = low_pass_output(&reducer->accel_lowpass[axis]);
            payload->gyro[axis] =
                high_pass_update(&reducer->gyro_highpass[axis], settings.gyro_highpass_gain, gyro);
        }
    }
    payload->flags = reducer->flags;
    if (!settings.raw) {
        payload->flags |= WIRE_ACCEL_FILTERED;
        if (settings.gyro_highpass_gain > 0) {
            payload->flags |= WIRE_GYRO_FILTERED;
        }
    }
    reducer->flags = 0;
}

}  // namespace

bool imu_read_bytes(const uint8_t *bytes, ImuReading *reading) {
    uint8_t same = 1;
    while (same < 14 && bytes[same] == bytes[0]) {
        ++same;
    }
    for (uint8_t axis = 0; axis < 3; ++axis) {
        reading->accel[axis] = word(bytes + 2 * axis);
        reading->gyro[axis] = word(bytes + 8 + 2 * axis);
    }
    reading->temperature = word(bytes + 6);
    return same < 14;
}

bool imu_reduce(ImuReducer *reducer, const ImuReducerSettings &settings, const ImuReading &reading,
                WireImu *payload) {
    take(reducer, settings, reading);
    // The sending rate need not divide the sensor's: the remainder is carried on.
    reducer->phase = static_cast<uint16_t>(reducer->phase + settings.send_hz);
    if (reducer->phase < settings.sample_hz) {
        return false;
    }
    reducer->phase = static_cast<uint16_t>(reducer->phase - settings.sample_hz);
    payload->temperature = reading.temperature;
    give(reducer, settings, payload);
    return true;
}
