/*
 * spread: weighted round robin. Each device gets a share of the jobs in proportion to its speed, evenly over the batch,
 * whatever the jobs' estimated loads and the devices' queues are: for an application whose estimates are worth nothing.
 *
 * A device gains credit with every job, as much as it is fast; the one with the most takes the job and pays for it what all
 * have gained together. So every device stays near its share all along, not only at the end.
 */
#include "gleaner_policy_v1.h"

#include <stdlib.h>

/* The layout that the host reads and writes: C99 has no static assert, but no array of negative size either. */
#define LAYOUT(name, holds) typedef char layout_of_##name[(holds) ? 1 : -1]
LAYOUT(job, sizeof(gleaner_job_v1) == 16);
LAYOUT(device, sizeof(gleaner_device_v1) == 40);
LAYOUT(batch, sizeof(gleaner_batch_v1) == 40);
LAYOUT(choice, sizeof(gleaner_choice_v1) == 8);
LAYOUT(policy, sizeof(struct gleaner_policy_v1) == 24);

enum { PLACED = 0, NO_MEMORY = 1 };

static int32_t place(const gleaner_batch_v1 *batch, gleaner_choice_v1 *choices)
{
    double *credit = calloc(batch->device_count, sizeof *credit);
    if (credit == NULL) {
        return NO_MEMORY;
    }
    for (uint32_t job = 0; job < batch->job_count; job++) {
        double gained = 0.0;
        uint32_t richest = 0;
        for (uint32_t device = 0; device < batch->device_count; device++) {
            double speed = 1.0 / batch->devices[device].time_per_load;
            credit[device] += speed;
            gained += speed;
            if (credit[device] > credit[richest]) {
                richest = device;
            }
        }
        credit[richest] -= gained;
        choices[job].job = job;
        choices[job].device = richest;
    }
    free(credit);
    return PLACED;
}

const struct gleaner_policy_v1 gleaner_policy_v1 = {
    GLEANER_POLICY_ABI_V1,
    sizeof(struct gleaner_policy_v1),
    "weighted round robin: jobs in proportion to speed, loads ignored",
    place,
};
