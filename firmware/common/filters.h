// SPDX-License-Identifier: Apache-2.0
// The node's filters, in fixed point: an ATmega328P has no floating-point unit.
#pragma once

#include <stdint.h>

// Second-order Butterworth low-pass,
//     y = b0 (x + 2 x1 + x2) - a1 y1 - a2 y2,
// by the bilinear transform with the cutoff pre-warped. It is computed as
//     y = 2 y1 - y2 + b0 (x + 2 x1 + x2) - c1 y1 + c2 y2,   c1 = 2 + a1, c2 = 1 - a2,
// for at a cutoff far below the rate a1 and a2 are nearly -2 and 1, and their differences from that
// are what counts. Coefficients have 31 fraction bits, the output 14.
struct LowPassDesign {
    int32_t b0;
    int32_t c1;
    int32_t c2;
};

struct LowPass {
    int16_t x1;
    int16_t x2;
    int32_t y1;
    int32_t y2;
};

constexpr uint8_t LOW_PASS_OUTPUT_BITS = 14;

// tan(x) for 0 <= x < 1.2, by its continued fraction; computed by the compiler alone.
constexpr double filters_tan(double x) {
    double denominator = 15.0;
    for (int odd = 13; odd >= 1; odd -= 2) {
        denominator = odd - x * x / denominator;
    }
    return x / denominator;
}

// cutoff_hz must not be above rate_hz / 10.
constexpr LowPassDesign low_pass_design(double cutoff_hz, double rate_hz) {
    const double k = filters_tan(3.14159265358979323846 * cutoff_hz / rate_hz);
    const double root2_k = 1.41421356237309504880 * k;
    const double norm = 1.0 / (1.0 + root2_k + k * k);
    const double one = 2147483648.0;
    const int32_t c1 = static_cast<int32_t>((2.0 * root2_k + 4.0 * k * k) * norm * one + 0.5);
    const int32_t c2 = static_cast<int32_t>(2.0 * root2_k * norm * one + 0.5);
    // From the rounded poles, so that a constant passes unchanged: 4 b0 = 1 + a1 + a2.
    return LowPassDesign{(c1 - c2) / 4, c1, c2};
}

// Starts the filter as if its input had always been `x`.
void low_pass_start(LowPass *filter, int16_t x);

// Takes one sample; the output is read with low_pass_output.
void low_pass_update(LowPass *filter, const LowPassDesign &design, int16_t x);

// Rounded to counts.
int16_t low_pass_output(const LowPass *filter);

// First-order high-pass: the input less its own low-pass of time constant 1 / (2 pi cutoff).
// It starts from zero, not from the first sample: a node that restarts in flight must not take
// the rate of a turn for a bias.
struct HighPass {
    int32_t mean;  // 16 fraction bits
};

// The share of the difference that the mean takes at each sample, 32 fraction bits.
constexpr uint32_t high_pass_gain(double cutoff_hz, double rate_hz) {
    return static_cast<uint32_t>(2.0 * 3.14159265358979323846 * cutoff_hz / rate_hz * 4294967296.0);
}

int16_t high_pass_update(HighPass *filter, uint32_t gain, int16_t x);

// Mean of the samples since the last taking, for decimation.
struct Mean {
    int32_t sum;
    uint8_t count;
};

void mean_add(Mean *mean, int16_t x);

// Rounded to counts; 0 without samples. Restarts the mean.
int16_t mean_take(Mean *mean);
