// SPDX-License-Identifier: Apache-2.0
// The fixed-point filters against the same filters in double precision.
#include <cmath>
#include <cstdint>

#include "common/filters.h"
#include "host_test/check.h"

namespace {

constexpr double PI = 3.14159265358979323846;
constexpr LowPassDesign DESIGN_10_1000 = low_pass_design(10.0, 1000.0);

double scale(int32_t coefficient) { return coefficient / std::ldexp(1.0, 31); }

struct Reference {
    double b0, a1, a2, x1 = 0, x2 = 0, y1 = 0, y2 = 0;

    Reference(double cutoff_hz, double rate_hz) {
        const double k = std::tan(PI * cutoff_hz / rate_hz);
        const double norm = 1 / (1 + std::sqrt(2.0) * k + k * k);
        b0 = k * k * norm;
        a1 = 2 * (k * k - 1) * norm;
        a2 = (1 - std::sqrt(2.0) * k + k * k) * norm;
    }

    double update(double x) {
        const double y = b0 * (x + 2 * x1 + x2) - a1 * y1 - a2 * y2;
        x2 = x1;
        x1 = x;
        y2 = y1;
        y1 = y;
        return y;
    }
};

double worst_error(double cutoff_hz, double rate_hz, int amplitude) {
    const LowPassDesign design = low_pass_design(cutoff_hz, rate_hz);
    Reference reference(cutoff_hz, rate_hz);
    LowPass filter;
    low_pass_start(&filter, 0);
    uint32_t random = 12345;
    double worst = 0;
    for (int i = 0; i < 20000; ++i) {
        random = random * 1664525 + 1013904223;
        const double noise = static_cast<double>(random >> 16) / 32768.0 - 1.0;
        const double tone = std::sin(2 * PI * cutoff_hz * i / rate_hz);
        const int16_t x = static_cast<int16_t>(amplitude * (0.5 * noise + 0.5 * tone));
        low_pass_update(&filter, design, x);
        worst = std::fmax(worst, std::fabs(reference.update(x) - low_pass_output(&filter)));
    }
    return worst;
}

}  // namespace

TEST(butterworth_coefficients_are_those_of_scipy) {
    // scipy.signal.butter(2, 10, fs=1000)
    CHECK_NEAR(scale(DESIGN_10_1000.b0), 9.44691843840153e-04, 1e-8);
    CHECK_NEAR(scale(DESIGN_10_1000.c1) - 2, -1.911197067426073, 1e-8);
    CHECK_NEAR(1 - scale(DESIGN_10_1000.c2), 0.914975834801434, 1e-8);
}

TEST(butterworth_follows_double_precision_to_a_count) {
    CHECK_NEAR(worst_error(10, 1000, 32767), 0, 0.6);
    CHECK_NEAR(worst_error(10, 500, 32767), 0, 0.6);
    CHECK_NEAR(worst_error(5, 1000, 32767), 0, 0.7);
    CHECK_NEAR(worst_error(100, 1000, 32767), 0, 0.6);
}

TEST(butterworth_passes_a_constant_and_starts_settled) {
    for (const int value : {-32768, -4097, 0, 1, 4096, 32767}) {
        LowPass filter;
        low_pass_start(&filter, static_cast<int16_t>(value));
        for (int i = 0; i < 5000; ++i) {
            low_pass_update(&filter, DESIGN_10_1000, static_cast<int16_t>(value));
            CHECK(low_pass_output(&filter) == value);
        }
    }
}

TEST(butterworth_saturates_where_it_overshoots) {
    LowPass filter;
    low_pass_start(&filter, -32768);
    int16_t highest = -32768;
    for (int i = 0; i < 300; ++i) {
        low_pass_update(&filter, DESIGN_10_1000, 32767);
        CHECK(low_pass_output(&filter) >= highest || low_pass_output(&filter) > 32000);
        highest = low_pass_output(&filter) > highest ? low_pass_output(&filter) : highest;
    }
    CHECK(highest == 32767);
}

TEST(high_pass_follows_double_precision) {
    constexpr double cutoff_hz = 0.01;
    constexpr double rate_hz = 100;
    const uint32_t gain = high_pass_gain(cutoff_hz, rate_hz);
    HighPass filter = {0};
    double mean = 0;
    for (int i = 0; i < 50000; ++i) {
        const int16_t x = static_cast<int16_t>(i < 20000 ? -30000 : 25000 + i % 7);
        CHECK_NEAR(high_pass_update(&filter, gain, x), std::fmax(-32768, std::fmin(32767, x - mean)), 1.1);
        mean += (x - mean) * 2 * PI * cutoff_hz / rate_hz;
    }
}

TEST(high_pass_leaves_the_first_sample_whole) {
    HighPass filter = {0};
    CHECK(high_pass_update(&filter, high_pass_gain(0.001, 100), 1234) == 1234);
}

TEST(mean_rounds_to_nearest) {
    Mean mean = {0, 0};
    CHECK(mean_take(&mean) == 0);
    for (const int x : {1, 2, 2}) {
        mean_add(&mean, static_cast<int16_t>(x));
    }
    CHECK(mean_take(&mean) == 2);
    for (const int x : {-1, -2, -2}) {
        mean_add(&mean, static_cast<int16_t>(x));
    }
    CHECK(mean_take(&mean) == -2);
    for (int i = 0; i < 17; ++i) {
        mean_add(&mean, -32768);
    }
    CHECK(mean_take(&mean) == -32768);
}
