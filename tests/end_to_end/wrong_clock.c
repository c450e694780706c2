/* Preloaded into a process: its civil clock is wrong by CLOCK_OFF_S seconds, or by the seconds in
   the file CLOCK_OFF_FILE, which may change; its other clocks are right. */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <fcntl.h>
#include <stdlib.h>
#include <sys/time.h>
#include <time.h>
#include <unistd.h>

static long off_s(void)
{
    const char *text = getenv("CLOCK_OFF_S");
    const char *path = getenv("CLOCK_OFF_FILE");
    char content[32] = "";
    if (path) {
        int file = open(path, O_RDONLY);
        if (file >= 0) {
            ssize_t size = read(file, content, sizeof content - 1);
            content[size > 0 ? size : 0] = 0;
            close(file);
            text = content;
        }
    }
    return text ? atol(text) : 0;
}

int clock_gettime(clockid_t id, struct timespec *now)
{
    static int (*real)(clockid_t, struct timespec *);
    if (!real)
        real = (int (*)(clockid_t, struct timespec *))dlsym(RTLD_NEXT, "clock_gettime");
    int result = real(id, now);
    if (result == 0 && (id == CLOCK_REALTIME || id == CLOCK_REALTIME_COARSE))
        now->tv_sec += off_s();
    return result;
}

time_t time(time_t *kept)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (kept)
        *kept = now.tv_sec;
    return now.tv_sec;
}

int gettimeofday(struct timeval *restrict tv, void *restrict zone)
{
    (void)zone;
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    tv->tv_sec = now.tv_sec;
    tv->tv_usec = now.tv_nsec / 1000;
    return 0;
}
