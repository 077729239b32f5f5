/*
 * What libFuzzer feeds: bytes are steps of an exported controller, which keeps its state between
 * them. `python -m experiments.fuzz_c` writes fuzz_limits.h and compiles this. What must hold is
 * written here anew, not taken from the code under test.
 */
#include <float.h>
#include <math.h>
#include <signal.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "plant.h"

#include "fuzz_limits.h"

#define N_OBS PLANT_N_OBS
#define N_INPUTS PLANT_N_INPUTS
#define SENSOR (PLANT_NOT_FINITE | PLANT_OUT_OF_RANGE | PLANT_FROZEN)
#define MUST(holds)                                                                                \
    if (!(holds)) {                                                                                \
        fprintf(stderr, "does not hold: %s\n", #holds);                                            \
        abort();                                                                                   \
    }

typedef plant_real real;

typedef struct {
    const uint8_t *at, *end;
} source;

static int byte(source *from) { return from->at < from->end ? *from->at++ : 0; }

/* Any bits at all. */
static real bits(source *from)
{
    uint8_t drawn[sizeof(real)];
    real found;
    for (size_t i = 0; i < sizeof drawn; i++) {
        drawn[i] = (uint8_t)byte(from);
    }
    memcpy(&found, drawn, sizeof found);
    return found;
}

/* A number: near `middle`, odd, the last one or just beside it, or any. */
static real number(source *from, real middle, real half, real last)
{
    static const real odd[] = {(real)NAN, (real)INFINITY, -(real)INFINITY, MOST, -MOST, LEAST,
                               -LEAST, (real)0.0, -(real)0.0, (real)1e30, (real)-1e-30, (real)1.0};
    const int kind = byte(from);
    if (kind < 160) { /* two bytes: from four half-widths below to four above */
        const int fine = 256 * kind + byte(from);
        return middle + half * (real)((fine - 20480) / 5120.0);
    }
    if (kind < 192) {
        return odd[kind % 12];
    }
    if (kind < 240) {
        return kind % 3 == 0 ? last : nextafter(last, kind % 3 == 1 ? -MOST : MOST);
    }
    return bits(from);
}

static int finite(const real values[], int count)
{
    int all = 1;
    for (int i = 0; i < count; i++) {
        all = all && isfinite(values[i]);
    }
    return all;
}

/* Outputs are numbers within the bounds of the inputs. */
static void check_bounds(const real action[N_INPUTS])
{
    for (int i = 0; i < N_INPUTS; i++) {
        MUST(isfinite(action[i]));
        MUST(action[i] >= lowest[i] - room[i] && action[i] <= highest[i] + room[i]);
    }
}

/* Whether a reading is farther away than any law goes, where readings are theta. */
static int is_far(const real obs[N_OBS])
{
    int far = 0;
    for (int i = 0; i < N_OBS && READS_THETA; i++) {
        far = far || (isfinite(obs[i]) && fabs(obs[i] - middle[i]) > 1e3 * half[i]);
    }
    return far;
}

/* What has no memory: the same answer twice, and the law where a reading is none. */
static void check_policy(const real obs[N_OBS])
{
    real action[N_INPUTS], again[N_INPUTS], law[N_INPUTS];
    const unsigned found = plant_policy(obs, action), by_law = plant_law(obs, law);
    check_bounds(action);
    check_bounds(law);
    MUST(plant_policy(obs, again) == found && memcmp(action, again, sizeof action) == 0);
    MUST((found & ~(PLANT_NOT_FINITE | PLANT_OUTSIDE | PLANT_NETWORK)) == 0);
    MUST(((found & PLANT_NOT_FINITE) != 0) == !finite(obs, N_OBS));
    MUST((found & ~PLANT_NETWORK) == by_law);
    MUST(!is_far(obs) || (found & PLANT_OUTSIDE));
    MUST(!(found & (PLANT_NOT_FINITE | PLANT_NETWORK)) || memcmp(action, law, sizeof law) == 0);
}

/* What a step says of its readings. */
static void check_status(const plant_state *state, unsigned found, const real obs[N_OBS],
                         real elapsed)
{
    real law[N_INPUTS];
    int beyond = 0;
    for (int i = 0; i < N_OBS; i++) {
        beyond = beyond || (isfinite(obs[i]) && (obs[i] < reading_min[i] || obs[i] > reading_max[i]));
    }
    MUST(found < 64u);
    MUST(((found & PLANT_NOT_FINITE) != 0) == !finite(obs, N_OBS));
    MUST(((found & PLANT_OUT_OF_RANGE) != 0) == beyond);
    MUST(((found & PLANT_LATE) != 0) == (elapsed > LATE_AFTER));
    MUST(FROZEN_AFTER > 0 || !(found & PLANT_FROZEN));
    MUST(finite(state->good, N_OBS));
    MUST((found & PLANT_OUTSIDE) == (plant_law(state->good, law) & PLANT_OUTSIDE));
    MUST(!(found & PLANT_NETWORK) || state->mode == PLANT_POLICY);
}

/* A reading that stands in for later ones is a good one, or the one from before. */
static void check_good(const plant_state *state, const real obs[N_OBS], const real kept[N_OBS])
{
    for (int i = 0; i < N_OBS; i++) {
        const int good = obs[i] >= reading_min[i] && obs[i] <= reading_max[i];
        MUST(state->good[i] == kept[i] || (good && isfinite(obs[i]) && state->good[i] == obs[i]));
    }
}

/* How long there have been faults, and none. */
typedef struct {
    int faults, sound;
} health;

/* Who may act. */
static void check_mode(const plant_state *state, unsigned found, int request, health *own)
{
    own->faults = found & SENSOR ? own->faults + 1 : 0;
    own->sound = found & (SENSOR | PLANT_LATE) ? 0 : own->sound < RECOVER ? own->sound + 1 : RECOVER;
    plant_mode acts = own->sound < RECOVER || request == PLANT_MPC ? PLANT_MPC : PLANT_POLICY;
    if (request == PLANT_MANUAL || own->faults > HOLD) {
        acts = PLANT_MANUAL;
    }
    MUST(state->mode == acts);
    MUST(state->steps == state->steps_of_mode[0] + state->steps_of_mode[1] + state->steps_of_mode[2]);
}

/* How far the output may move: `before` is the last output. */
static void check_rates(const real obs[N_OBS], const real before[N_INPUTS],
                        const real action[N_INPUTS], int shown)
{
#if RATED
    const real *says = obs + N_OBS - N_INPUTS; /* the readings of the previous input */
    int good = 1;
    for (int i = 0; i < N_INPUTS; i++) {
        const int at = N_OBS - N_INPUTS + i;
        good = good && isfinite(says[i]) && says[i] >= reading_min[at] && says[i] <= reading_max[at];
    }
    for (int i = 0; i < N_INPUTS; i++) {
        if (shown || !good) { /* the controller knows what it put out */
            MUST(action[i] - before[i] >= change_min[i] - room[i]);
            MUST(action[i] - before[i] <= change_max[i] + room[i]);
        } else {
            const real last = (says[i] - shown_at[i]) / shown_per[i];
            MUST(action[i] >= fmin(last + change_min[i], highest[i]) - room[i]);
            MUST(action[i] <= fmax(last + change_max[i], lowest[i]) + room[i]);
        }
    }
#else
    (void)obs, (void)before, (void)action, (void)shown;
#endif
}

/* At a change of who acts the output goes on from where it was; with no manual output it is held. */
static void check_transfer(const plant_state *state, plant_mode acted, int given,
                           const real before[N_INPUTS], const real action[N_INPUTS])
{
    const int held = state->mode == PLANT_MANUAL && !given;
    const int goes_on = state->mode != PLANT_MANUAL && state->mode != acted && TRANSFER > 0;
    for (int i = 0; i < N_INPUTS && !RATED; i++) {
        MUST(!held || action[i] == before[i]);
        MUST(!goes_on || fabs(action[i] - before[i]) <= room[i] || UNBOUNDED);
    }
}

/* One step of the controller, drawn from the bytes. */
static void step(source *from, plant_state *state, health *own)
{
    real obs[N_OBS], kept[N_OBS], manual[N_INPUTS], before[N_INPUTS], action[N_INPUTS];
    const int flags = byte(from), shown = (flags & 4) != 0, manual_there = (flags & 8) != 0;
    const int request = (flags & 0xf0) == 0xf0 ? byte(from) : flags & 3;
    const plant_mode acted = state->mode;
    for (int i = 0; i < N_OBS; i++) {
        obs[i] = flags & 16 ? state->last[i] : number(from, middle[i], half[i], state->last[i]);
    }
    for (int i = 0; i < N_INPUTS; i++) {
        before[i] = state->output[i];
        manual[i] = manual_there ? number(from, before[i], range_of[i], before[i]) : (real)0.0;
#if RATED
        if (shown) {
            obs[N_OBS - N_INPUTS + i] = before[i] * shown_per[i] + shown_at[i];
        }
#endif
    }
    memcpy(kept, state->good, sizeof kept);
    const real elapsed = flags & 32 ? number(from, (real)1.0, (real)0.5, (real)1.0) : (real)1.0;
    const int given = manual_there && request == PLANT_MANUAL && finite(manual, N_INPUTS);
    const unsigned found = plant_step(state, obs, elapsed, (plant_mode)request,
                                      manual_there ? manual : NULL, action);
    check_bounds(action);
    MUST(memcmp(action, state->output, sizeof action) == 0);
    check_status(state, found, obs, elapsed);
    check_good(state, obs, kept);
    check_mode(state, found, request, own);
    check_rates(obs, before, action, shown);
    if (given || !manual_there || request != PLANT_MANUAL) { /* some of them given: neither */
        check_transfer(state, acted, given, before, action);
    }
    check_policy(obs);
}

/* Ends the run when it has had its seconds of a core, which libFuzzer does not count. */
static void end_in_time(unsigned long steps)
{
    const char *given = getenv("FUZZ_SECONDS");
    if (given != NULL && (double)clock() / CLOCKS_PER_SEC > atof(given)) {
        fprintf(stderr, "steps: %lu\n", steps);
        raise(SIGUSR1);
    }
}

int selftest(void); /* main() of plant_selftest.c */

int LLVMFuzzerInitialize(int *argc, char ***argv)
{
    (void)argc, (void)argv;
    MUST(selftest() == 0 || !TESTED);
    return 0;
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size)
{
    static unsigned long steps;
    source from = {data, data + size};
    plant_state state;
    health own;
    memset(&state, 0xff, sizeof state); /* plant_init() must not leave anything out */
    plant_init(&state);
    own.faults = 0, own.sound = RECOVER;
    check_bounds(state.output);
    while (from.at < from.end) {
        step(&from, &state, &own);
        steps++;
    }
    end_in_time(steps);
    return 0;
}
