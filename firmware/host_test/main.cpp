// SPDX-License-Identifier: Apache-2.0
#include "host_test/check.h"

int main() {
    for (const TestCase &test : test_cases()) {
        const int before = failed_checks();
        test.run();
        std::printf("%s %s\n", failed_checks() == before ? "ok    " : "FAILED", test.name);
    }
    std::printf("%zu tests, %d failed checks\n", test_cases().size(), failed_checks());
    return failed_checks() == 0 ? 0 : 1;
}
