// SPDX-License-Identifier: Apache-2.0
// From readings at the sensor's rate to payloads at the sending rate: filters and decimation.
//
//     acceleration   Butterworth low-pass at the sensor's rate, its latest output sent;
//                    raw: mean since the last payload
//     angular rate   mean since the last payload (so that no rotation is lost between payloads),
//                    then the high-pass; raw: the mean alone
//
// A reading on the last count of its range sets a flag in the next payload.
#pragma once

#include <stdint.h>

#include "common/filters.h"
#include "common/wire.h"

struct ImuReading {
    int16_t accel[3];
    int16_t temperature;
    int16_t gyro[3];
};

struct ImuReducerSettings {
    uint16_t sample_hz;
    uint16_t send_hz;
    bool raw;
    LowPassDesign accel_lowpass;
    uint32_t gyro_highpass_gain;
};

struct ImuReducer {
    bool started;
    uint16_t phase;
    uint16_t flags;
    LowPass accel_lowpass[3];
    Mean accel_mean[3];
    Mean gyro_mean[3];
    HighPass gyro_highpass[3];
};

// Reads the fourteen big-endian bytes of registers 0x3B to 0x48. False if they are all the same: a
// chip that is not awake, or nobody on the bus.
bool imu_read_bytes(const uint8_t *bytes, ImuReading *reading);

// Takes one reading. True if a payload is due: then its accelerations, rates, temperature and the
// filter and clipping flags are filled in.
bool imu_reduce(ImuReducer *reducer, const ImuReducerSettings &settings, const ImuReading &reading,
                WireImu *payload);
