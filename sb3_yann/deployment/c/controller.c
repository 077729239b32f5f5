/*
@ABOUT@
 */
#include <math.h>
#include <stddef.h>
#include <stdint.h>

#include "@FILE@.h"

#if YANN_EXPORT_ID != @EXPORT@u
#error "@FILE@.h is of another export than this file: export again"
#endif

typedef yann_real real;

#define N_OBS YANN_N_OBS
#define N_SEEN YANN_N_SEEN
#define N_INPUTS YANN_N_INPUTS
#define ZERO ((real)0)
#define ONE ((real)1)

@TABLES@

@ONLINE@
/* ---- The region that theta lies in, or that it violates least ---- */

/* The smallest slack of a region's half-spaces, or some slack below `low`. */
static real slack_of_region(int region, const real theta[N_THETA], real low)
{
    real smallest = INFINITY;
    for (int row = starts[region]; row < starts[region + 1]; row++) {
        real slack = b[row];
        for (int j = 0; j < N_THETA; j++) {
            slack -= A[row][j] * theta[j];
        }
        if (slack < smallest) {
            smallest = slack;
            if (smallest < low) {
                break;
            }
        }
    }
    return smallest;
}

/* What ties with a slack is at least this. */
static real nearly(real slack) { return slack - TIE * (ONE + FABS(slack)); }

/* The first region that ties with the best. `known` is the slack of some region. */
static int scan(const real theta[N_THETA], real known, int disjoint, real *inside)
{
    int best = 0;
    real largest = -INFINITY;
    real low = nearly(known);
    for (int i = 0; i < N_REGIONS; i++) {
        const real slack = slack_of_region(i, theta, low);
        if (slack < low) {
            continue;
        }
        if (disjoint && slack >= SURELY_INSIDE) {
            *inside = slack;
            return i;
        }
        if (slack > largest) {
            largest = slack;
            best = i;
            low = nearly(slack) > low ? nearly(slack) : low;
        }
    }
    *inside = largest;
    low = nearly(largest);
    for (int i = 0; i < best; i++) {
        if (slack_of_region(i, theta, low) >= low) {
            return i;
        }
    }
    return best;
}

#if SEARCH_BY_WALK
/* Along a line from the first region to theta, from neighbor to neighbor. */
static int walk(const real theta[N_THETA])
{
    int region = WALK_FROM;
    real reached = ZERO;
    for (int visited = 0; visited < N_REGIONS; visited++) {
        real leaves = INFINITY;
        int out = -1;
        for (int row = starts[region]; row < starts[region + 1]; row++) {
            real slack = b[row];
            for (int j = 0; j < N_THETA; j++) {
                slack -= A[row][j] * theta[j];
            }
            if (slack < ZERO && slack < walk_slack[row]) {
                const real there = walk_slack[row] / (walk_slack[row] - slack);
                if (there < leaves) {
                    leaves = there;
                    out = row;
                }
            }
        }
        if (out < 0 || leaves < reached - BACK || neighbors[out] < 0) {
            break;
        }
        region = neighbors[out];
        reached = leaves > reached ? leaves : reached;
    }
    return region;
}
#endif

static int locate(const real theta[N_THETA], real *inside)
{
    real known = -INFINITY;
    real room = ONE; /* how far inside the box */
    for (int j = 0; j < N_THETA; j++) {
        const real left = ONE - FABS(theta[j] - box_middle[j]) * box_per_half[j];
        room = left < room ? left : room;
    }
    const int disjoint = DISJOINT && room >= -TOLERANCE; /* beyond it regions may overlap */
#if SEARCH_BY_WALK
    if (disjoint) {
        const int found = walk(theta);
        known = slack_of_region(found, theta, -INFINITY);
        if (known >= SURELY_INSIDE) {
            *inside = known;
            return found;
        }
    }
#endif
    const int region = scan(theta, known, disjoint, inside);
    *inside = room < *inside ? room : *inside;
    return region;
}

/* ---- Networks: exactly zero before they have learnt ---- */

#if N_NETWORKS > 0
static real activate(real x) { return ACTIVATION; }

static void hidden_layer(int rows, int columns, const real weights[], int pinned, const real x[],
                         real y[])
{
    for (int a = 0; a < rows; a++) {
        const real *row = weights + (ptrdiff_t)a * (columns + 1);
        real sum = row[columns];
        for (int j = 0; j < columns; j++) {
            sum += row[j] * x[j];
        }
        y[a] = activate(sum) - (pinned ? activate(row[columns]) : ZERO);
    }
}

/* What network k adds to the law, in [-1, 1] for the input range; 0 if it is no number. */
static int correction(int k, const real theta[N_THETA], real added[N_INPUTS])
{
    real x[N_THETA], first[WIDTH_1];
    const real *last = first;
    int at_zero = pinned[k], sound = 1;
    for (int j = 0; j < N_THETA; j++) {
        x[j] = theta[j] * per_theta[j];
        at_zero = at_zero && x[j] == ZERO;
    }
    hidden_layer(WIDTH_1, N_THETA, &layer0[k][0][0], pinned[k], x, first);
#if N_LAYERS > 2
    real second[WIDTH_2];
    hidden_layer(WIDTH_2, WIDTH_1, &layer1[k][0][0], pinned[k], first, second);
    last = second;
#endif
    for (int i = 0; i < N_INPUTS; i++) {
        real sum = pinned[k] ? ZERO : last_layer[k][i][WIDTH_LAST];
        for (int j = 0; j < WIDTH_LAST; j++) {
            sum += last_layer[k][i][j] * last[j];
        }
        added[i] = at_zero ? ZERO : sum;
        sound = sound && isfinite(added[i]);
    }
    for (int i = 0; i < N_INPUTS; i++) {
        added[i] = !sound ? ZERO : added[i] > REACH ? REACH : added[i] < -REACH ? -REACH : added[i];
    }
    return sound;
}

/* The part, from 1 to 0, of a correction that counts at theta. */
static real part_that_counts(const real theta[N_THETA])
{
    real beyond = ZERO;
    for (int j = 0; j < N_THETA; j++) {
        const real far = FABS(theta[j] - confine_middle[j]) * confine_per_half[j];
        beyond = far > beyond ? far : beyond;
    }
    const real part = (FADES_TO - beyond) / (FADES_TO - FADES_FROM);
    return part > ONE ? ONE : part > ZERO ? part : ZERO;
}
#endif

/* ---- Law and policy ---- */

static real between(real value, real low, real high)
{
    return value < low ? low : value > high ? high : value;
}

#if N_NETWORKS > 0 && N_KEPT > 0
/* The row of `kept` that an action is furthest beyond, -1 for none, and by how much. `share` of the
   way from the law goes no further beyond any. */
static int worst_row(const real theta[N_THETA], const real law[N_INPUTS],
                     const real action[N_INPUTS], real *most, real *share)
{
    int worst = -1;
    *most = ZERO;
    *share = ONE;
    for (int row = 0; row < N_KEPT; row++) {
        const real *a = kept[row], *b = kept[row] + N_THETA, *end = kept[row] + N_THETA + N_INPUTS;
        real slack = end[0], push = ZERO;
        for (int j = 0; j < N_THETA; j++) {
            slack -= a[j] * theta[j];
        }
        for (int i = 0; i < N_INPUTS; i++) {
            slack -= b[i] * law[i];
            push += b[i] * (action[i] - law[i]);
        }
        const real room = slack > end[1] ? slack - end[1] : ZERO;
        const real beyond = push - (slack < room ? slack : room);
        if (push * *share > room + KEPT_ROUNDING) {
            *share = (room + KEPT_ROUNDING) / push;
        }
        if (beyond > *most) {
            *most = beyond;
            worst = row;
        }
    }
    return worst;
}

/* Move an action to where it breaks no row further than the law. */
static void keep(const real theta[N_THETA], const real law[N_INPUTS], const real low[N_INPUTS],
                 const real high[N_INPUTS], real action[N_INPUTS])
{
    real most, share;
    const int worst = worst_row(theta, law, action, &most, &share);
    if (worst < 0) {
        return;
    }
    for (int i = 0; i < N_INPUTS; i++) {
        action[i] -= most * kept[worst][N_THETA + i];
        action[i] = between(action[i], law[i] - REACH, law[i] + REACH);
        action[i] = between(action[i], low[i], high[i]);
    }
    (void)worst_row(theta, law, action, &most, &share);
    for (int i = 0; i < N_INPUTS; i++) {
        action[i] = between(law[i] + share * (action[i] - law[i]), low[i], high[i]);
    }
}
#endif

/* Write the action, and the bounds that it keeps, in the units of the plant or the env. */
static unsigned act(const real seen[N_SEEN], int with_networks, real action[N_INPUTS],
                    real low[N_INPUTS], real high[N_INPUTS])
{
    real theta[N_THETA], law[N_INPUTS], inside;
    unsigned status = 0;
    for (int i = 0; i < N_SEEN; i++) {
        if (!isfinite(seen[i])) {
            status |= YANN_NOT_FINITE;
        }
    }
    for (int j = 0; j < N_THETA; j++) {
        int known = 1;
        theta[j] = obs_offset[j];
        for (int i = 0; i < N_SEEN; i++) {
            if (obs_matrix[j][i] != ZERO) {
                theta[j] += obs_matrix[j][i] * seen[i];
                known = known && isfinite(seen[i]);
            }
        }
        /* What is not finite counts as at the operating point, what is beyond as at the end. */
        theta[j] = known && theta[j] == theta[j] ? theta[j] : ZERO;
        theta[j] = between(theta[j], theta_min[j], theta_max[j]);
    }
    const int region = locate(theta, &inside);
#if ONLINE
    real less[N_INPUTS];
    inside = solve(theta, less);
#endif
    if (inside < -TOLERANCE) {
        status |= YANN_OUTSIDE;
    }
    for (int i = 0; i < N_INPUTS; i++) {
        law[i] = offsets[region][i];
        for (int j = 0; j < N_THETA; j++) {
            law[i] += gains[region][i][j] * theta[j];
        }
#if ONLINE
        law[i] -= less[i];
#endif
#if ZERO_INPUT
        if (inside < -TOLERANCE) {
            law[i] = resting[i];
        }
#endif
        law[i] = law[i] == law[i] ? law[i] : ZERO;
        low[i] = input_min[i];
        high[i] = input_max[i];
        law[i] = between(law[i], low[i], high[i]);
#if MOVING
        /* Bounds in theta, the lower one first. */
        if (moving_min[i] >= 0) {
            const real shown = theta[moving_min[i]] * per_input[i] - middle[i];
            low[i] = between(shown, input_min[i], input_max[i]);
        }
        if (moving_max[i] >= 0) {
            const real shown = theta[moving_max[i]] * per_input[i] - middle[i];
            high[i] = between(shown, input_min[i], input_max[i]);
        }
        high[i] = high[i] > low[i] ? high[i] : low[i];
#endif
#if RATE
        /* They are reached as fast as the rate allows. */
        const real previous = theta[N_THETA - N_INPUTS + i] * per_input[i] - middle[i];
        const real slowest = between(previous + change_min[i], input_min[i], input_max[i]);
        const real fastest = between(previous + change_max[i], input_min[i], input_max[i]);
        low[i] = between(low[i], slowest, fastest);
        high[i] = between(high[i], slowest, fastest);
#endif
        law[i] = between(law[i], low[i], high[i]);
    }
#if N_NETWORKS > 0
    const real part = part_that_counts(theta);
    if (with_networks && !(status & YANN_NOT_FINITE) && network_of[region] >= 0 && part > ZERO) {
        real added[N_INPUTS];
        int adds = 0;
        if (!correction(network_of[region], theta, added)) {
            status |= YANN_NETWORK;
        }
        for (int i = 0; i < N_INPUTS; i++) {
            const real total = law[i] + added[i] * part;
            adds = adds || total != law[i];
            added[i] = between(total, low[i], high[i]);
        }
#if N_KEPT > 0
        if (adds) {
            keep(theta, law, low, high, added);
        }
#endif
        for (int i = 0; i < N_INPUTS && adds; i++) {
            law[i] = added[i];
        }
    }
#else
    (void)with_networks;
#endif
    for (int i = 0; i < N_INPUTS; i++) {
        action[i] = law[i] * action_scale[i] + action_shift[i];
        low[i] = low[i] * action_scale[i] + action_shift[i];
        high[i] = high[i] * action_scale[i] + action_shift[i];
    }
    return status;
}

unsigned yann_policy(const real seen[N_SEEN], real action[N_INPUTS])
{
    real low[N_INPUTS], high[N_INPUTS];
    return act(seen, 1, action, low, high);
}

unsigned yann_law(const real seen[N_SEEN], real action[N_INPUTS])
{
    real low[N_INPUTS], high[N_INPUTS];
    return act(seen, 0, action, low, high);
}

@ESTIMATOR@
/* ---- One step of the plant's controller ---- */

void yann_init(yann_state *state)
{
    for (int i = 0; i < N_OBS; i++) {
        state->good[i] = obs_rest[i];
        state->last[i] = obs_rest[i];
        state->same[i] = 0;
        state->absent[i] = 0;
    }
    for (int i = 0; i < N_INPUTS; i++) {
        state->output[i] = resting[i] * action_scale[i] + action_shift[i];
        state->bump[i] = ZERO;
        state->anchor[i] = ZERO;
    }
    state->faults = 0;
    state->sound = RECOVER;
    state->left = 0;
    state->started = 0;
    state->mode = YANN_POLICY;
    state->steps = 0;
    state->changes = 0;
    for (int i = 0; i < 3; i++) {
        state->steps_of_mode[i] = 0;
    }
    for (int i = 0; i < 6; i++) {
        state->found[i] = 0;
    }
}

/* Keep what is good of the readings; return what is wrong with the others, NaN in `good`. */
static unsigned read_sensors(yann_state *state, const real obs[N_OBS], real good[N_OBS])
{
    unsigned status = 0;
    int drives = 0;
    state->moved = !state->started;
    for (int i = 0; i < N_OBS; i++) {
        /* What is not finite has not moved. */
        if (isfinite(obs[i]) && isfinite(state->last[i]) && obs[i] != state->last[i]) {
            state->moved = 1;
        }
    }
    for (int i = 0; i < N_INPUTS; i++) {
        const real away = state->output[i] - state->anchor[i];
        const real least = DRIVING * (input_max[i] - input_min[i]) * action_scale[i];
        drives = drives || away > least || -away > least;
    }
    for (int i = 0; i < N_OBS; i++) {
        unsigned fault = 0;
        if (!state->started || obs[i] != state->last[i]) {
            state->same[i] = 0;
        } else if ((state->moved || drives) && state->same[i] < FROZEN_AFTER) {
            state->same[i]++;
        }
        state->last[i] = obs[i];
        good[i] = (real)NAN;
        if (!isfinite(obs[i])) {
            state->absent[i] += state->absent[i] <= missing[i] ? 1 : 0;
            fault = state->absent[i] > missing[i] ? YANN_NOT_FINITE : 0;
        } else {
            state->absent[i] = 0;
            if (obs[i] < obs_min[i] || obs[i] > obs_max[i]) {
                fault |= YANN_OUT_OF_RANGE;
            }
            if (FROZEN_AFTER > 0 && watched[i] && state->same[i] >= FROZEN_AFTER) {
                fault |= YANN_FROZEN;
            }
        }
        if (fault == 0 && isfinite(obs[i])) {
            state->good[i] = good[i] = obs[i];
        }
        status |= fault;
    }
    state->started = 1;
    return status;
}

#if RATE
/* Whether a reading of the previous input is faulty. */
static int previous_is_lost(const yann_state *state, const real obs[N_OBS])
{
    for (int i = 0; i < N_INPUTS; i++) {
        for (int j = 0; j < N_SEEN; j++) {
            const int at = source[j];
            if (obs_matrix[N_THETA - N_INPUTS + i][j] != ZERO && at < N_OBS &&
                !(state->good[at] == obs[at])) {
                return 1;
            }
        }
    }
    return 0;
}
#endif

/* What the policy sees: good readings, estimates and the last input, each in its place. */
static void look(yann_state *state, const real good[N_OBS], int begins, int told,
                 real seen[N_SEEN])
{
#if N_ESTIMATES > 0
    estimate(state, good, begins, told);
    for (int j = 0; j < N_SEEN; j++) {
        const int at = source[j] - N_OBS, input = at - N_ESTIMATES;
        if (input >= 0) {
            seen[j] = state->output[input] * input_scale[input] + input_shift[input];
        } else if (at >= 0) {
            state->estimate[at] = between(state->estimate[at], est_min[at], est_max[at]);
            seen[j] = state->estimate[at];
        } else {
            seen[j] = state->good[source[j]];
        }
    }
#else
    (void)good, (void)begins, (void)told;
    for (int j = 0; j < N_SEEN; j++) {
        seen[j] = state->good[source[j]];
    }
#endif
}

/* Who acts now. */
static yann_mode who_acts(yann_state *state, unsigned status, yann_mode request)
{
    if ((status & (YANN_NOT_FINITE | YANN_OUT_OF_RANGE | YANN_FROZEN)) == 0) {
        state->faults = 0;
    } else if (state->faults <= HOLD) {
        state->faults++;
    }
    if (status != 0) {
        state->sound = 0;
    } else if (state->sound < RECOVER) {
        state->sound++;
    }
    if (request == YANN_MANUAL || state->faults > HOLD) {
        return YANN_MANUAL;
    }
    return request == YANN_MPC || state->sound < RECOVER ? YANN_MPC : YANN_POLICY;
}

unsigned yann_step(yann_state *state, const real obs[N_OBS], real elapsed, yann_mode request,
                   const real *manual, real action[N_INPUTS])
{
    real target[N_INPUTS], low[N_INPUTS], high[N_INPUTS], good[N_OBS], seen[N_SEEN];
    const int begins = !state->started;
    int told = begins && manual != NULL;
    for (int i = 0; i < N_INPUTS && told; i++) {
        told = isfinite(manual[i]);
    }
    for (int i = 0; i < N_INPUTS && told; i++) {
        state->output[i] = manual[i];
    }
    unsigned status = read_sensors(state, obs, good);
    if (elapsed > LATE_AFTER) {
        status |= YANN_LATE;
    }
    const yann_mode mode = who_acts(state, status, request);
    for (int i = 0; i < N_INPUTS && manual != NULL; i++) {
        if ((begins || request == YANN_MANUAL) && !isfinite(manual[i])) {
            status |= YANN_NOT_FINITE; /* it is held, which is no fault of a sensor */
        }
    }
    look(state, good, begins, told, seen);
    status |= act(seen, mode == YANN_POLICY, target, low, high);
#if RATE
    /* Rates count from the own output then. */
    for (int i = 0; i < N_INPUTS && previous_is_lost(state, obs); i++) {
        const real last = (state->output[i] - action_shift[i]) / action_scale[i];
        low[i] = between(last + change_min[i], input_min[i], input_max[i]);
        high[i] = between(last + change_max[i], input_min[i], input_max[i]);
        low[i] = low[i] * action_scale[i] + action_shift[i];
        high[i] = high[i] * action_scale[i] + action_shift[i];
    }
#endif
    for (int i = 0; i < N_INPUTS; i++) {
        if (mode == YANN_MANUAL) {
            const int given = request == YANN_MANUAL && manual != NULL && isfinite(manual[i]);
            target[i] = given ? manual[i] : state->output[i];
        }
        if (mode != state->mode || told) {
            state->bump[i] = state->output[i] - target[i];
        }
    }
    if (mode != state->mode || told) {
        state->changes += mode != state->mode ? 1 : 0;
        state->left = TRANSFER;
    }
    if (mode == YANN_MANUAL) {
        state->left = 0; /* the operator's output is taken as it is */
    }
    for (int i = 0; i < N_INPUTS; i++) {
        if (state->left > 0) {
            target[i] += state->bump[i] * ((real)state->left / (real)TRANSFER);
        }
        state->output[i] = between(target[i], low[i], high[i]);
        action[i] = state->output[i];
        state->anchor[i] = state->moved ? action[i] : state->anchor[i];
    }
    if (state->left > 0) {
        state->left--;
    }
    state->mode = mode;
    state->steps++;
    state->steps_of_mode[mode]++;
    for (int i = 0; i < 6; i++) {
        state->found[i] += (status >> i) & 1u;
    }
    return status;
}
