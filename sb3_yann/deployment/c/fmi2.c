/*
 * FMI 2.0 for co-simulation around @FILE@.c: inputs obs, request, has_manual and manual; outputs
 * command, status and mode. A communication step is one step of the controller; its size is dt.
 */
#include <stdlib.h>
#include <string.h>

#include "@FILE@.h"

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

typedef void *fmi2Component;
typedef void *fmi2ComponentEnvironment;
typedef void *fmi2FMUstate;
typedef unsigned int fmi2ValueReference;
typedef double fmi2Real;
typedef int fmi2Integer;
typedef int fmi2Boolean;
typedef char fmi2Char;
typedef const fmi2Char *fmi2String;
typedef char fmi2Byte;
typedef enum { fmi2OK, fmi2Warning, fmi2Discard, fmi2Error, fmi2Fatal, fmi2Pending } fmi2Status;
typedef enum { fmi2ModelExchange, fmi2CoSimulation } fmi2Type;
typedef enum {
    fmi2DoStepStatus,
    fmi2PendingStatus,
    fmi2LastSuccessfulTime,
    fmi2Terminated
} fmi2StatusKind;
typedef struct fmi2CallbackFunctions fmi2CallbackFunctions;

#define N_OBS YANN_N_OBS
#define N_INPUTS YANN_N_INPUTS
#define DT @DT@

/* References of the variables: obs, then manual, then command; request, status, mode; has_manual. */
typedef struct {
    yann_state state;
    yann_real obs[N_OBS], manual[N_INPUTS], command[N_INPUTS];
    int request, status, mode, has_manual;
} controller;

static yann_real *number_of(controller *own, fmi2ValueReference reference)
{
    if (reference < N_OBS) {
        return &own->obs[reference];
    }
    reference -= N_OBS;
    if (reference < N_INPUTS) {
        return &own->manual[reference];
    }
    reference -= N_INPUTS;
    return reference < N_INPUTS ? &own->command[reference] : NULL;
}

static int *whole_of(controller *own, fmi2ValueReference reference)
{
    int *const all[] = {&own->request, &own->status, &own->mode};
    return reference < 3 ? all[reference] : NULL;
}

static void begin(controller *own)
{
    memset(own, 0, sizeof *own);
    yann_init(&own->state);
    for (int i = 0; i < N_OBS; i++) {
        own->obs[i] = own->state.good[i]; /* the operating point */
    }
    for (int i = 0; i < N_INPUTS; i++) {
        own->command[i] = own->state.output[i];
    }
}

EXPORT const char *fmi2GetTypesPlatform(void) { return "default"; }
EXPORT const char *fmi2GetVersion(void) { return "2.0"; }

EXPORT fmi2Component fmi2Instantiate(fmi2String name, fmi2Type type, fmi2String guid,
                                     fmi2String resources, const fmi2CallbackFunctions *functions,
                                     fmi2Boolean visible, fmi2Boolean logging)
{
    (void)name, (void)resources, (void)functions, (void)visible, (void)logging;
    if (type != fmi2CoSimulation || guid == NULL || strcmp(guid, "@GUID@") != 0) {
        return NULL;
    }
    controller *own = malloc(sizeof *own);
    if (own != NULL) {
        begin(own);
    }
    return own;
}

EXPORT void fmi2FreeInstance(fmi2Component c) { free(c); }

EXPORT fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean on, size_t n,
                                      const fmi2String categories[])
{
    (void)c, (void)on, (void)n, (void)categories;
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean has_tolerance,
                                      fmi2Real tolerance, fmi2Real start, fmi2Boolean has_stop,
                                      fmi2Real stop)
{
    (void)c, (void)has_tolerance, (void)tolerance, (void)start, (void)has_stop, (void)stop;
    return fmi2OK;
}

EXPORT fmi2Status fmi2EnterInitializationMode(fmi2Component c) { return c ? fmi2OK : fmi2Error; }
EXPORT fmi2Status fmi2ExitInitializationMode(fmi2Component c) { return c ? fmi2OK : fmi2Error; }
EXPORT fmi2Status fmi2Terminate(fmi2Component c) { return c ? fmi2OK : fmi2Error; }

EXPORT fmi2Status fmi2Reset(fmi2Component c)
{
    begin(c);
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference r[], size_t n,
                              fmi2Real value[])
{
    for (size_t i = 0; i < n; i++) {
        const yann_real *found = number_of(c, r[i]);
        if (found == NULL) {
            return fmi2Error;
        }
        value[i] = (fmi2Real)*found;
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference r[], size_t n,
                              const fmi2Real value[])
{
    for (size_t i = 0; i < n; i++) {
        yann_real *found = number_of(c, r[i]);
        if (found == NULL) {
            return fmi2Error;
        }
        *found = (yann_real)value[i];
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                 fmi2Integer value[])
{
    for (size_t i = 0; i < n; i++) {
        const int *found = whole_of(c, r[i]);
        if (found == NULL) {
            return fmi2Error;
        }
        value[i] = *found;
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                 const fmi2Integer value[])
{
    for (size_t i = 0; i < n; i++) {
        int *found = whole_of(c, r[i]);
        if (found == NULL || value[i] < 0 || value[i] > 2) {
            return fmi2Error;
        }
        *found = value[i];
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                 fmi2Boolean value[])
{
    for (size_t i = 0; i < n; i++) {
        if (r[i] != 0) {
            return fmi2Error;
        }
        value[i] = ((controller *)c)->has_manual;
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                 const fmi2Boolean value[])
{
    for (size_t i = 0; i < n; i++) {
        if (r[i] != 0) {
            return fmi2Error;
        }
        ((controller *)c)->has_manual = value[i] != 0;
    }
    return fmi2OK;
}

EXPORT fmi2Status fmi2DoStep(fmi2Component c, fmi2Real time, fmi2Real size, fmi2Boolean no_undo)
{
    controller *own = c;
    (void)time, (void)no_undo;
    own->status = (int)yann_step(&own->state, own->obs, (yann_real)(size / DT),
                                 (yann_mode)own->request, own->has_manual ? own->manual : NULL,
                                 own->command);
    own->mode = (int)own->state.mode;
    return fmi2OK;
}

/* What this FMU does not offer, as its description says. */
EXPORT fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                fmi2String value[])
{
    (void)c, (void)r, (void)value;
    return n ? fmi2Error : fmi2OK;
}
EXPORT fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference r[], size_t n,
                                const fmi2String value[])
{
    (void)c, (void)r, (void)value;
    return n ? fmi2Error : fmi2OK;
}
EXPORT fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c, (void)state;
    return fmi2Error;
}
EXPORT fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate state)
{
    (void)c, (void)state;
    return fmi2Error;
}
EXPORT fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *state)
{
    (void)c, (void)state;
    return fmi2Error;
}
EXPORT fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate state, size_t *size)
{
    (void)c, (void)state, (void)size;
    return fmi2Error;
}
EXPORT fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate state, fmi2Byte bytes[],
                                        size_t size)
{
    (void)c, (void)state, (void)bytes, (void)size;
    return fmi2Error;
}
EXPORT fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte bytes[], size_t size,
                                          fmi2FMUstate *state)
{
    (void)c, (void)bytes, (void)size, (void)state;
    return fmi2Error;
}
EXPORT fmi2Status fmi2GetDirectionalDerivative(fmi2Component c, const fmi2ValueReference of[],
                                               size_t n, const fmi2ValueReference by[], size_t m,
                                               const fmi2Real along[], fmi2Real value[])
{
    (void)c, (void)of, (void)n, (void)by, (void)m, (void)along, (void)value;
    return fmi2Error;
}
EXPORT fmi2Status fmi2SetRealInputDerivatives(fmi2Component c, const fmi2ValueReference r[],
                                              size_t n, const fmi2Integer order[],
                                              const fmi2Real value[])
{
    (void)c, (void)r, (void)n, (void)order, (void)value;
    return fmi2Error;
}
EXPORT fmi2Status fmi2GetRealOutputDerivatives(fmi2Component c, const fmi2ValueReference r[],
                                               size_t n, const fmi2Integer order[],
                                               fmi2Real value[])
{
    (void)c, (void)r, (void)n, (void)order, (void)value;
    return fmi2Error;
}
EXPORT fmi2Status fmi2CancelStep(fmi2Component c)
{
    (void)c;
    return fmi2Error;
}
EXPORT fmi2Status fmi2GetStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Status *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
EXPORT fmi2Status fmi2GetRealStatus(fmi2Component c, const fmi2StatusKind kind, fmi2Real *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
EXPORT fmi2Status fmi2GetIntegerStatus(fmi2Component c, const fmi2StatusKind kind,
                                       fmi2Integer *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
EXPORT fmi2Status fmi2GetBooleanStatus(fmi2Component c, const fmi2StatusKind kind,
                                       fmi2Boolean *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
EXPORT fmi2Status fmi2GetStringStatus(fmi2Component c, const fmi2StatusKind kind,
                                      fmi2String *value)
{
    (void)c, (void)kind, (void)value;
    return fmi2Discard;
}
