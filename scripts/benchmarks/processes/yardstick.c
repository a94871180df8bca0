// The yardstick: the least that a C program can do to pass a sensor's samples on, and the least that can take them.
//
//   yardstick master RAW CLIENT RATE_HZ PRIORITY OUTPUTS SENSORS
//   yardstick client PORT FILE WARM_UP_S SECONDS
//
// `master` takes over two descriptors, an AF_PACKET socket to sensors in OP and a TCP connection. For each sample it
// exchanges one LRW, at the sample's own instant, which the signal `clock` tells: it needs to estimate nothing. New
// samples go out as DATA messages.
// `client` subscribes, at the master or at ethercat-server, and writes what arrives, as records.py has it.
#define _GNU_SOURCE
#include <arpa/inet.h>
#include <endian.h>
#include <fcntl.h>
#include <netinet/tcp.h>
#include <sched.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { INPUT = 61, HEAD = 33, MESSAGE = HEAD + INPUT, MOST_SENSORS = 16, FIRST_DATA = 26 };
static const int64_t kSecond = 1000000000, kWrap = (int64_t)1000000000 << 20;
static const int64_t kAgain = 10000;    // ns until the next exchange if one brought nothing new
static const int64_t kPatience = 5000000;  // ns until an answer is lost

struct Sample { int64_t number, instant; };
struct Records { int64_t *values; size_t count, room; };

static void fail(const char *what) {
    perror(what);
    exit(1);
}

static int64_t now_ns(clockid_t clock) {
    struct timespec t;
    clock_gettime(clock, &t);
    return t.tv_sec * kSecond + t.tv_nsec;
}

static void keep(struct Records *records, int64_t value) {
    if (records->count == records->room) {
        records->room = records->room ? 2 * records->room : 1 << 16;
        records->values = realloc(records->values, records->room * sizeof value);
        if (!records->values) fail("memory");
    }
    records->values[records->count++] = value;
}

// The file is there only when it is complete.
static void write_records(const struct Records *records, const char *path) {
    char unfinished[4096];
    snprintf(unfinished, sizeof unfinished, "%s.unfinished", path);
    FILE *file = fopen(unfinished, "wb");
    if (!file || fwrite(records->values, sizeof(int64_t), records->count, file) != records->count || fclose(file) ||
        rename(unfinished, path))
        fail(path);
}

// Number and instant as the signal `clock` has them; the instant is the one nearest to `now`.
static struct Sample decode(const uint8_t *input, int64_t now) {
    float value[4];
    memcpy(value, input + 5, sizeof value);
    int64_t instant = (int64_t)value[1] * kSecond + (int64_t)value[2] * 1000 + (int64_t)value[3];
    return (struct Sample){(int64_t)value[0], instant + (now - instant + kWrap / 2) / kWrap * kWrap};
}

static void put(uint8_t *message, uint64_t sequence, int64_t back, unsigned sensor, unsigned wkc, const uint8_t *input) {
    const uint32_t length = htobe32(MESSAGE - 4);
    const uint64_t numbers[3] = {htobe64(sequence), htobe64((uint64_t)now_ns(CLOCK_REALTIME)), htobe64((uint64_t)back)};
    const uint8_t rest[4] = {(uint8_t)sensor, 0, (uint8_t)(wkc >> 8), (uint8_t)wkc};
    memcpy(message, &length, 4);
    message[4] = 1;
    memcpy(message + 5, numbers, 24);
    memcpy(message + 29, rest, 4);
    memcpy(message + HEAD, input, INPUT);
}

static void master(char **argument) {
    const int raw = atoi(argument[0]), client = atoi(argument[1]), priority = atoi(argument[3]);
    const unsigned outputs = (unsigned)atoi(argument[4]), sensors = (unsigned)atoi(argument[5]);
    const int64_t nominal = (int64_t)(1e9 / atof(argument[2]));
    const unsigned length = outputs + INPUT * sensors, size = FIRST_DATA + length + 2;
    uint8_t frame[1514] = {255, 255, 255, 255, 255, 255, 1, 1, 1, 1, 1, 1, 0x88, 0xA4}, answer[1514];
    frame[14] = (uint8_t)(size - 16), frame[15] = (uint8_t)(0x10 | (size - 16) >> 8);
    frame[16] = 12;  // LRW of logical address 0
    frame[22] = (uint8_t)length, frame[23] = (uint8_t)(length >> 8);

    struct sched_param param = {.sched_priority = priority};
    if (priority && sched_setscheduler(0, SCHED_FIFO, &param)) fail("priority");
    if (priority) mlockall(MCL_CURRENT);  // where allowed
    if (!priority) prctl(PR_SET_TIMERSLACK, 1000);
    signal(SIGPIPE, SIG_IGN);
    const int yes = 1;
    const struct timeval patience = {.tv_usec = kPatience / 1000};
    setsockopt(client, IPPROTO_TCP, TCP_NODELAY, &yes, sizeof yes);
    setsockopt(raw, SOL_SOCKET, SO_RCVTIMEO, &patience, sizeof patience);
    fcntl(raw, F_SETFL, fcntl(raw, F_GETFL) & ~O_NONBLOCK);

    struct Sample newest[MOST_SENSORS] = {0};
    int64_t period[MOST_SENSORS], next[MOST_SENSORS] = {0};
    uint64_t sequence[MOST_SENSORS] = {0};
    for (unsigned i = 0; i < sensors; ++i) period[i] = nominal, newest[i].number = -1;
    for (;;) {
        int64_t due = next[0], woke = now_ns(CLOCK_MONOTONIC);
        for (unsigned i = 1; i < sensors; ++i) due = next[i] < due ? next[i] : due;
        if (due > woke) {
            const struct timespec at = {due / kSecond, due % kSecond};
            clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL);
            woke = now_ns(CLOCK_MONOTONIC);
        }
        ++frame[17];
        send(raw, frame, size < 60 ? 60 : size, 0);
        int got = 0;
        int64_t back = woke;
        while (!got && back - woke < kPatience) {
            got = recv(raw, answer, sizeof answer, 0) >= (ssize_t)size && answer[17] == frame[17];
            back = now_ns(CLOCK_MONOTONIC);
        }
        if (!got) continue;
        uint8_t messages[MESSAGE * MOST_SENSORS];
        size_t filled = 0;
        for (unsigned i = 0; i < sensors; ++i) {
            const uint8_t *input = answer + FIRST_DATA + outputs + INPUT * i;
            const struct Sample sample = decode(input, back);
            const int64_t steps = sample.number - newest[i].number;
            if (!steps) {
                if (next[i] < back) next[i] = back + kAgain;
                continue;
            }
            if (sequence[i] && steps > 0) period[i] = (sample.instant - newest[i].instant) / steps;
            newest[i] = sample;
            next[i] = sample.instant + period[i];
            const unsigned wkc = answer[size - 2] | (unsigned)answer[size - 1] << 8;
            put(messages + filled, sequence[i]++, back, i, wkc, input);
            filled += MESSAGE;
        }
        if (filled && send(client, messages, filled, 0) < 0) return;
    }
}

static int connected(int port) {
    const struct sockaddr_in address = {
        .sin_family = AF_INET, .sin_port = htons((uint16_t)port), .sin_addr.s_addr = htonl(INADDR_LOOPBACK)};
    for (;;) {
        const int fd = socket(AF_INET, SOCK_STREAM, 0);
        if (connect(fd, (const struct sockaddr *)&address, sizeof address) == 0) return fd;
        close(fd);
        usleep(20000);
    }
}

static void client(char **argument) {
    static uint8_t buffer[1 << 16];
    const int fd = connected(atoi(argument[0]));
    const int64_t warm_up = (int64_t)(atof(argument[2]) * 1e9), measured = (int64_t)(atof(argument[3]) * 1e9);
    struct Records records = {0};
    int64_t from = 0, until = 0, now = 0;
    size_t held = 0;
    static const char subscribe[] = "\0\0\0\x17\2{\"action\":\"subscribe\"}";
    if (send(fd, subscribe, sizeof subscribe - 1, 0) < 0) fail("subscribe");
    while (!until || now < until) {
        const ssize_t size = recv(fd, buffer + held, sizeof buffer - held, 0);
        now = now_ns(CLOCK_MONOTONIC);
        if (size <= 0) fail("the master is gone");
        held += (size_t)size;
        if (!from) from = now + warm_up;
        size_t taken = 0;
        for (uint32_t length; held - taken >= HEAD; taken += length) {
            memcpy(&length, buffer + taken, 4);
            length = be32toh(length) + 4;
            if (held - taken < length) break;
            const uint8_t *message = buffer + taken;
            if (now < from || message[4] != 1 || message[30] & 3) continue;  // a reply; REPEATED, INVALID
            if (!until) {
                char began[4096];
                snprintf(began, sizeof began, "%s.began", argument[1]);
                fclose(fopen(began, "w"));
                until = now + measured;
            }
            const struct Sample sample = decode(message + HEAD, now);
            uint64_t stamp;
            memcpy(&stamp, message + 21, sizeof stamp);
            const int64_t record[] = {message[29], sample.number, sample.instant, (int64_t)be64toh(stamp), now};
            for (int i = 0; i < 5; ++i) keep(&records, record[i]);
        }
        memmove(buffer, buffer + taken, held -= taken);
    }
    write_records(&records, argument[1]);
}

int main(int count, char **argument) {
    if (count == 8 && !strcmp(argument[1], "master"))
        master(argument + 2);
    else if (count == 6 && !strcmp(argument[1], "client"))
        client(argument + 2);
    else
        return fprintf(stderr, "usage: see the first lines of yardstick.c\n"), 2;
    return 0;
}
