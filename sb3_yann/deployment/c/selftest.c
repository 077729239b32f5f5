/*
 * A test of @FILE@.c with known answers: it returns 0 and prints the largest error, in parts of an
 * input's range, or returns 1. Compile it with @FILE@.c, and run it on the target.
 */
#include <math.h>
#include <stddef.h>
#include <stdio.h>

#include "@FILE@.h"

#if YANN_EXPORT_ID != @EXPORT@u
#error "@FILE@.h is of another export than this file: export again"
#endif

#define N_POINTS @POINTS@
#define N_STEPS @STEPS@

@VECTORS@

static double worst(const yann_real found[], const yann_real wanted[])
{
    double largest = 0.0;
    for (int i = 0; i < YANN_N_INPUTS; i++) {
        const double error = fabs((double)found[i] - (double)wanted[i]) / (double)range_of[i];
        if (!(error <= largest)) { /* NaN too */
            largest = error;
        }
    }
    return largest;
}

/* Where the MPC has no solution constraints give way, which costs digits. */
static double room_at(unsigned status)
{
    return status & YANN_OUTSIDE ? @ROOM_OUTSIDE@ : @ROOM_INSIDE@;
}

int main(void)
{
    static yann_state state;
    yann_real action[YANN_N_INPUTS];
    double by_policy = 0.0, by_law = 0.0, by_step = 0.0, room = 0.0;
    int wrong = 0;
    for (int k = 0; k < N_POINTS; k++) {
        room = room_at(yann_policy(points[k], action));
        by_policy = fmax(by_policy, worst(action, policy[k]));
        wrong += !(worst(action, policy[k]) <= room);
        (void)yann_law(points[k], action);
        by_law = fmax(by_law, worst(action, law[k]));
        wrong += !(worst(action, law[k]) <= room);
    }
    yann_init(&state);
    room = 0.0;
    for (int k = 0; k < N_STEPS; k++) {
        yann_real obs[YANN_N_OBS];
        for (int i = 0; i < YANN_N_OBS; i++) {
            obs[i] = readings[k][i];
        }
        if (lost[k]) {
            obs[0] = (yann_real)NAN;
        }
        const unsigned found =
            yann_step(&state, obs, elapsed[k], (yann_mode)requests[k], NULL, action);
        room = fmax(room, room_at(found)); /* an output is held, and fades */
        by_step = fmax(by_step, worst(action, actions[k]));
        wrong += !(worst(action, actions[k]) <= room);
        wrong += found != (unsigned)status[k] || state.mode != (yann_mode)modes[k];
    }
    printf("@FILE@: largest error %.2g (policy), %.2g (law), %.2g (steps) of the range; %s\n",
           by_policy, by_law, by_step, wrong ? "FAILED" : "passed");
    return wrong ? 1 : 0;
}
