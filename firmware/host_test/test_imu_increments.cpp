// SPDX-License-Identifier: Apache-2.0
// The payloads' rotation and force against the same motion in double precision.
#include <cmath>
#include <cstdint>

#include "common/imu_increments.h"
#include "common/lora.h"
#include "host_test/check.h"

namespace {

constexpr double SAMPLE_HZ = 1000.0;
constexpr double RADPS_PER_COUNT = 1000.0 / 32768.0 * 3.14159265358979323846 / 180.0;
constexpr double FORCE = 4096.0;  // 1 g in counts

struct Vector {
    double x, y, z;
};

struct Quaternion {
    double w, x, y, z;
};

Quaternion multiply(const Quaternion &a, const Quaternion &b) {
    return {a.w * b.w - a.x * b.x - a.y * b.y - a.z * b.z, a.w * b.x + a.x * b.w + a.y * b.z - a.z * b.y,
            a.w * b.y - a.x * b.z + a.y * b.w + a.z * b.x, a.w * b.z + a.x * b.y - a.y * b.x + a.z * b.w};
}

Quaternion rotation(const Vector &v) {
    const double angle = std::sqrt(v.x * v.x + v.y * v.y + v.z * v.z);
    const double share = angle > 1e-12 ? std::sin(angle / 2) / angle : 0.5;
    return {std::cos(angle / 2), share * v.x, share * v.y, share * v.z};
}

// Turns a vector of the world into axes with this attitude.
Vector into(const Quaternion &q, const Vector &v) {
    const Quaternion inverse = {q.w, -q.x, -q.y, -q.z};
    const Quaternion turned = multiply(multiply(inverse, {0, v.x, v.y, v.z}), q);
    return {turned.x, turned.y, turned.z};
}

// Angle between two attitudes, deg.
double between(const Quaternion &a, const Quaternion &b) {
    const Quaternion d = multiply({a.w, -a.x, -a.y, -a.z}, b);
    return 2 * std::atan2(std::sqrt(d.x * d.x + d.y * d.y + d.z * d.z), std::fabs(d.w)) * 180.0 / M_PI;
}

struct Errors {
    double angle_deg;     // of the attitude after 10 s
    double force_counts;  // the largest of one axis of one payload
};

// Follows the payloads as the gateway does, at rates given in rad/s as functions of the time.
template <typename Rates>
Errors follow(Rates rates, int send_hz) {
    ImuIncrements increments = {};
    const int16_t scale = static_cast<int16_t>(increment_scale(250.0, SAMPLE_HZ) << 2);
    const ImuIncrementSettings settings = {1000, static_cast<uint16_t>(send_hz), scale};
    Quaternion truth = {1, 0, 0, 0};
    Quaternion sent = truth;
    Quaternion middle = truth;
    Errors errors = {0, 0};
    const int every = 1000 / send_hz;
    for (int i = 0; i < 10000; ++i) {
        const Vector w = rates((i + 0.5) / SAMPLE_HZ);
        const Quaternion half = rotation({w.x / 2000, w.y / 2000, w.z / 2000});
        truth = multiply(truth, half);
        const Vector f = into(truth, {0, 0, -FORCE});
        const ImuReading reading = {
            {static_cast<int16_t>(std::lround(f.x)), static_cast<int16_t>(std::lround(f.y)),
             static_cast<int16_t>(std::lround(f.z))},
            0,
            {static_cast<int16_t>(std::lround(w.x / RADPS_PER_COUNT)),
             static_cast<int16_t>(std::lround(w.y / RADPS_PER_COUNT)),
             static_cast<int16_t>(std::lround(w.z / RADPS_PER_COUNT))}};
        truth = multiply(truth, half);
        WireImu payload = {};
        if (!imu_increment(&increments, settings, reading, &payload)) {
            continue;
        }
        const double step = RADPS_PER_COUNT * every / SAMPLE_HZ / 2;
        const Quaternion turn = rotation({payload.gyro[0] * step, payload.gyro[1] * step, payload.gyro[2] * step});
        middle = multiply(sent, turn);
        sent = multiply(middle, turn);
        const Vector force = into({middle.w, -middle.x, -middle.y, -middle.z},
                                  {static_cast<double>(payload.accel[0]), static_cast<double>(payload.accel[1]),
                                   static_cast<double>(payload.accel[2])});
        errors.force_counts = std::fmax(errors.force_counts, std::fmax(std::fabs(force.x), std::fabs(force.y)));
        errors.force_counts = std::fmax(errors.force_counts, std::fabs(force.z + FORCE));
    }
    errors.angle_deg = between(truth, sent);
    return errors;
}

}  // namespace

TEST(rotation_about_one_axis_keeps_angle_and_force) {
    for (const double degps : {0.0, 30.0, -200.0}) {
        const Errors errors = follow([&](double) { return Vector{degps * M_PI / 180, 0, 0}; }, 10);
        CHECK(errors.angle_deg < 0.2);
        CHECK(errors.force_counts < 0.006 * FORCE);
    }
}

TEST(coning_between_payloads_leaves_no_drift) {
    // A cone of 10 deg at 5 Hz: the mean rates alone drift by 27 deg in 10 s.
    const auto cone = [](double t) {
        const double a = 10.0 * M_PI / 180;
        const double w = 2 * M_PI * 5;
        return Vector{-a * w * std::sin(w * t), a * w * std::cos(w * t), 0.0};
    };
    const Errors errors = follow(cone, 10);
    CHECK(errors.angle_deg < 0.5);
    CHECK(errors.force_counts < 0.01 * FORCE);
}

TEST(tumbling_keeps_the_attitude) {
    const auto tumble = [](double t) {
        return Vector{2.0 * std::sin(3 * t), 1.5 * std::cos(2 * t), std::sin(t)};
    };
    const Errors errors = follow(tumble, 10);
    CHECK(errors.angle_deg < 0.3);
    CHECK(errors.force_counts < 0.006 * FORCE);
}

TEST(a_reading_at_the_end_of_its_range_sets_a_flag_once) {
    ImuIncrements increments = {};
    const ImuIncrementSettings settings = {1000, 10, increment_scale(250.0, 1000.0)};
    WireImu payload = {};
    ImuReading reading = {{0, 0, INT16_MIN}, 0, {INT16_MAX, 0, 0}};
    for (int i = 0; i < 100; ++i) {
        imu_increment(&increments, settings, reading, &payload);
    }
    CHECK(payload.flags == (WIRE_ACCEL_CLIPPED | WIRE_GYRO_CLIPPED));
    reading = ImuReading{{0, 0, -4096}, 0, {0, 0, 0}};
    for (int i = 0; i < 100; ++i) {
        imu_increment(&increments, settings, reading, &payload);
    }
    CHECK(payload.flags == 0);
}

TEST(airtime_follows_the_datasheet) {
    // By Semtech's calculator: SF7, 125 kHz, 4/5, 10 bytes; SF9, 125 kHz, 4/5, 20 bytes; SF7, 250 kHz, 32.
    CHECK_NEAR(lora_airtime_us({7, 125, 5}, 10), 41216, 1);
    CHECK_NEAR(lora_airtime_us({9, 125, 5}, 20), 185344, 1);
    CHECK_NEAR(lora_airtime_us({7, 250, 5}, 32), 35968, 1);
    CHECK_NEAR(lora_airtime_us({10, 500, 8}, 33), 156160, 1);
}
