// SPDX-License-Identifier: Apache-2.0
// The least that a test needs: named cases that register themselves and a check that reports.
#pragma once

#include <cstdio>
#include <vector>

struct TestCase {
    const char *name;
    void (*run)();
};

inline std::vector<TestCase> &test_cases() {
    static std::vector<TestCase> cases;
    return cases;
}

inline int &failed_checks() {
    static int failed = 0;
    return failed;
}

struct TestRegistration {
    TestRegistration(const char *name, void (*run)()) { test_cases().push_back({name, run}); }
};

#define TEST(name)                                          \
    static void name();                                     \
    static const TestRegistration register_##name(#name, name); \
    static void name()

#define CHECK(condition)                                                             \
    do {                                                                             \
        if (!(condition)) {                                                          \
            std::printf("%s:%d: failed: %s\n", __FILE__, __LINE__, #condition);      \
            ++failed_checks();                                                       \
        }                                                                            \
    } while (false)

#define CHECK_NEAR(value, expected, limit)                                           \
    do {                                                                             \
        const double value_ = static_cast<double>(value);                            \
        const double expected_ = static_cast<double>(expected);                      \
        if (!(value_ - expected_ <= (limit) && expected_ - value_ <= (limit))) {     \
            std::printf("%s:%d: %s is %.9g, expected %.9g\n", __FILE__, __LINE__,    \
                        #value, value_, expected_);                                  \
            ++failed_checks();                                                       \
        }                                                                            \
    } while (false)
