/*
 * The least firmware around a controller: it steps through observations and counts instructions.
 * The emulator runs one instruction in a nanosecond, and the timer counts 25 million in a second.
 */
#include <stdint.h>

#include "plant.h"
#include "points.h"

#define SYSTICK ((volatile uint32_t *)0xE000E010u)
#define CPACR (*(volatile uint32_t *)0xE000ED88u)
#define PER_TICK 40u

extern uint32_t __stack;
void reset(void);
__attribute__((section(".vectors"), used)) static const void *const vectors[] = {
    &__stack, (const void *)reset};

static plant_state state;
volatile plant_real shown[PLANT_N_INPUTS]; /* what a plant would take */

static void semihosting(uint32_t operation, const void *argument)
{
    register uint32_t r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xAB" : "+r"(r0) : "r"(r1) : "memory");
}

static void print(const char *label, uint32_t value)
{
    char text[12], *at = text + sizeof text;
    *--at = '\0';
    *--at = '\n';
    do {
        *--at = (char)('0' + value % 10u);
        value /= 10u;
    } while (value);
    semihosting(0x04, label); /* SYS_WRITE0 */
    semihosting(0x04, at);
}

static void step(int k)
{
    plant_real action[PLANT_N_INPUTS];
    (void)plant_step(&state, points[k], 1, PLANT_POLICY, 0, action);
    for (int i = 0; i < PLANT_N_INPUTS; i++) {
        shown[i] = action[i];
    }
}

static void __attribute__((noinline)) run(void)
{
    uint32_t worst = 0, sum = 0, off = 0;
    SYSTICK[1] = 0x00FFFFFFu;
    SYSTICK[2] = 0;
    SYSTICK[0] = 5u;
    plant_init(&state);
    for (int k = 0; k < N_POINTS; k++) {
        const uint32_t began = SYSTICK[2];
        step(k);
        const uint32_t took = (began - SYSTICK[2]) & 0x00FFFFFFu;
        worst = took > worst ? took : worst;
        sum += took;
        for (int i = 0; i < PLANT_N_INPUTS; i++) {
            const float error = (float)(shown[i] - answers[k][i]);
            off += error > ROOM || error < -ROOM || error != error;
        }
    }
    print("mean ", sum * PER_TICK / N_POINTS);
    print("worst ", worst * PER_TICK);
    print("wrong ", off);
    semihosting(0x18, (void *)0x20026u); /* stopped, as planned */
}

void reset(void)
{
    CPACR |= 0xFu << 20; /* the floating-point unit, before any function that saves its registers */
    __asm__ volatile("dsb\n isb");
    run();
    for (;;) {
    }
}
