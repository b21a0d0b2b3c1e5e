/* Example of a plant: exchange of UDP packets with `jaxhil rig --connect PORT`.
 *
 * This is version 3 of the protocol in udp_protocol.py, for little-endian processors. Replace this file with
 * the four functions of your hardware.
 */
#define _POSIX_C_SOURCE 200809L
#include <arpa/inet.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

#include "rt_model.h"

enum { BODY_VALUES = AXES == 6 ? START_VALUES : 0, BODIES_AT = 32 + 5 * 8 * AXES }; /* states of the bodies */
enum { READING_SIZE = 40 + 8 * (2 * AXES + START_VALUES), ANSWER_SIZE = BODIES_AT + 8 * BODY_VALUES + 104 };

typedef struct {
    int socket;
    struct sockaddr_in peer;
    bool has_peer, is_open, has_first;
    readings first; /* of the packet with which the session begins */
    uint64_t session;
    uint32_t sequence, run, tick;
    unsigned char packet[READING_SIZE + 1], answer[ANSWER_SIZE];
} udp_plant;

static udp_plant the_plant;

static uint32_t get_uint32(const unsigned char *from) {
    uint32_t value;
    memcpy(&value, from, sizeof value);
    return value;
}

static double seconds_now(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

/* Answer a request for a session, or store the readings of a packet; return whether there are readings. */
static bool take_packet(udp_plant *udp, size_t size, const struct sockaddr_in *sender, readings *now) {
    unsigned char *const packet = udp->packet;
    const bool is_peer = udp->has_peer && sender->sin_port == udp->peer.sin_port &&
                         sender->sin_addr.s_addr == udp->peer.sin_addr.s_addr;
    if (size == 24 && memcmp(packet, "JHas\3", 5) == 0 && (is_peer || !udp->is_open)) {
        memcpy(packet, "JHop\3", 5);
        packet[5] = AXES;
        memcpy(packet + 16, &udp->session, 8);
        udp->peer = *sender;
        udp->has_peer = true;
        sendto(udp->socket, packet, 24, 0, (const struct sockaddr *)sender, sizeof *sender);
        return false;
    }
    if (!is_peer || size != READING_SIZE || memcmp(packet, "JHrd\3", 5) != 0 || packet[6] != AXES ||
        memcmp(packet + 8, &udp->session, 8) != 0) {
        return false;
    }
    const uint32_t sequence = get_uint32(packet + 16);
    if (udp->is_open && packet[5] != STOP && (int32_t)(sequence - udp->sequence) <= 0) {
        return false; /* an old packet */
    }
    udp->is_open = true;
    udp->sequence = sequence;
    now->event = packet[5];
    now->run = udp->run = get_uint32(packet + 20);
    now->tick = udp->tick = get_uint32(packet + 24);
    memcpy(&now->time, packet + 32, 8);
    memcpy(now->force, packet + 40, sizeof now->force);
    memcpy(now->position, packet + 40 + 8 * AXES, sizeof now->position);
    memcpy(now->start, packet + 40 + 16 * AXES, sizeof now->start);
    return true;
}

/* Wait up to `wait` us for readings; return the newest ones. */
static bool udp_receive(udp_plant *udp, readings *now, long wait) {
    bool has_readings = false;
    for (;;) {
        struct sockaddr_in sender;
        socklen_t length = sizeof sender;
        const ssize_t size = recvfrom(udp->socket, udp->packet, sizeof udp->packet, MSG_DONTWAIT,
                                      (struct sockaddr *)&sender, &length);
        if (size >= 0) {
            has_readings = take_packet(udp, (size_t)size, &sender, now) || has_readings;
            if (has_readings && now->event == STOP) {
                return true;
            }
        } else if (has_readings || wait == 0) {
            return has_readings;
        } else {
            struct timeval timeout = {wait / 1000000, wait % 1000000};
            fd_set ready;
            FD_ZERO(&ready);
            FD_SET(udp->socket, &ready);
            select(udp->socket + 1, &ready, NULL, NULL, &timeout);
            wait = 0;
        }
    }
}

static bool udp_open(void *plant) {
    udp_plant *const udp = (udp_plant *)plant;
    struct sockaddr_in address = udp->peer; /* with the port of the option --port */
    socklen_t length = sizeof address;
    struct timespec now;
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    clock_gettime(CLOCK_REALTIME, &now);
    udp->session = (uint64_t)now.tv_sec * 1000000000u + (uint64_t)now.tv_nsec;
    udp->socket = socket(AF_INET, SOCK_DGRAM, 0);
    if (udp->socket < 0 || bind(udp->socket, (struct sockaddr *)&address, sizeof address) != 0 ||
        getsockname(udp->socket, (struct sockaddr *)&address, &length) != 0) {
        perror("rt_loop: UDP socket");
        return false;
    }
    printf("port %d\n", ntohs(address.sin_port));
    fflush(stdout);
    for (int number = 0; number < 300 && !stop_requested; number++) {
        udp->has_first = udp_receive(udp, &udp->first, 100000);
        if (udp->has_first) {
            return true; /* the loop begins in phase with the first packet */
        }
    }
    return false;
}

/* Wait up to half a period. Shift the loop so that it wakes up shortly before the packet of the rig arrives. */
static bool udp_read(void *plant, readings *now) {
    udp_plant *const udp = (udp_plant *)plant;
    const bool has_newer = udp_receive(udp, now, 0);
    if (udp->has_first && !has_newer) {
        *now = udp->first;
    }
    now->shift = -PERIOD / 50.0;
    if (udp->has_first || has_newer) {
        udp->has_first = false;
        return true;
    }
    const double begin = seconds_now();
    const bool has_readings = udp_receive(udp, now, (long)(5e5 * PERIOD));
    now->shift = has_readings ? (seconds_now() - begin - PERIOD / 20.0) / 8.0 : 0.0;
    return has_readings;
}

/* Write "tripped: " and the names of the faults, at most 95 characters. */
static void describe_trip(uint32_t cause, char *text) {
    size_t length = 8;
    memcpy(text, "tripped:", 8);
    for (uint32_t bit = 1; bit != 0; bit <<= 1) {
        const char *const name = jaxhil_fault_name(bit);
        const size_t size = strlen(name);
        if ((cause & bit) && length + size < 95) {
            text[length] = ' ';
            memcpy(text + length + 1, name, size);
            length += size + 1;
        }
    }
}

static bool udp_write(void *plant, const commands *answer) {
    udp_plant *const udp = (udp_plant *)plant;
    const uint64_t faults = answer->faults;
    unsigned char *const packet = udp->answer;
    memset(packet, 0, sizeof udp->answer);
    memcpy(packet, "JHan\3", 5);
    packet[5] = (unsigned char)answer->flags;
    packet[6] = AXES;
    memcpy(packet + 8, &udp->session, 8);
    memcpy(packet + 16, &udp->sequence, 4);
    memcpy(packet + 20, &udp->run, 4);
    memcpy(packet + 24, &udp->tick, 4);
    const double *const vectors[5] = {answer->position, answer->rate, answer->model_position,
                                      answer->model_velocity, answer->force};
    for (int n = 0; n < 5; n++) {
        memcpy(packet + 32 + n * 8 * AXES, vectors[n], 8 * AXES);
    }
    double bodies[START_VALUES];
    const size_t count = rt_bodies(bodies);
    memcpy(packet + BODIES_AT, bodies, 8 * count);
    memcpy(packet + ANSWER_SIZE - 104, &faults, 8);
    if (answer->flags & TRIPPED) {
        describe_trip(answer->cause, (char *)packet + ANSWER_SIZE - 96);
    }
    return sendto(udp->socket, packet, sizeof udp->answer, 0, (const struct sockaddr *)&udp->peer,
                  sizeof udp->peer) == (ssize_t)sizeof udp->answer;
}

static void udp_close(void *plant) { close(((udp_plant *)plant)->socket); }

bool rt_plant_option(const char *name, const char *value) {
    if (strcmp(name, "--port") != 0) {
        return false;
    }
    the_plant.peer.sin_port = htons((uint16_t)strtol(value, NULL, 10));
    return true;
}

const plant_io rt_plant = {udp_open, udp_read, udp_write, udp_close, &the_plant};
