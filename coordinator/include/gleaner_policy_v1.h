/*
 * Gleaner placement plug-ins, ABI 1: how the jobs of a batch are spread over the devices that may take them.
 *
 * A plug-in is a shared object NAME.so (NAME: 1 to 64 of a-z, 0-9, '_', '-') in the coordinator's plug-in folder. It
 * exports one constant:
 *
 *     const struct gleaner_policy_v1 gleaner_policy_v1 = {
 *         GLEANER_POLICY_ABI_V1, sizeof(struct gleaner_policy_v1), "what it does", place
 *     };
 *
 * Ownership: everything that the host hands to place() belongs to the host and is gone when place() returns. Nothing of
 * it may be kept or freed. What the plug-in allocates it frees itself.
 *
 * Threads: the host calls place() from one thread, one call at a time. Static variables live as long as the process,
 * which ends whenever the host likes: keep nothing in them that may not be lost.
 *
 * Time: place() should take about a microsecond for each job. One that takes too long is killed with its process.
 *
 * Errors: a batch that place() does not answer, or answers wrongly, is placed first come, first served. The process has
 * no environment variables, the working directory "/", and nothing on stdin; stdout and stderr go to the coordinator's
 * log, a limited number of lines.
 *
 * C99. 64-bit platforms.
 */
#ifndef GLEANER_POLICY_V1_H
#define GLEANER_POLICY_V1_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* The version of everything in this file. */
#define GLEANER_POLICY_ABI_V1 1u

/* What a choice holds before place() fills it in: no job, no device. */
#define GLEANER_NONE_V1 UINT32_MAX

/* A job that wants a place. 16 bytes. */
typedef struct gleaner_job_v1 {
    /*
     * Estimated work, above zero: nanoseconds on a device of speed 1.0 if the application said so, else in a unit of the
     * batch's own.
     */
    double load;
    /* Its index in the task: the same job of the application's next task has the same one. */
    uint32_t index;
    /* Zero. */
    uint32_t reserved;
} gleaner_job_v1;

/* A device that may take any job of the batch. 40 bytes. */
typedef struct gleaner_device_v1 {
    /* When it will be done with what it has, in nanoseconds from now; not negative. */
    double free_at_ns;
    /* Nanoseconds that one unit of load takes there; above zero. */
    double time_per_load;
    /* When what it lacks of the batch's data can be there, in nanoseconds from now; zero if it has all of it. */
    double ready_at_ns;
    /* Its node: devices with the same number are in one machine. Says nothing else. */
    uint64_t node;
    /* Its index in the node. */
    uint32_t device;
    /* Zero. */
    uint32_t reserved;
} gleaner_device_v1;

/* What is to be placed. 40 bytes. */
typedef struct gleaner_batch_v1 {
    /* Whose jobs; never the same number for two applications. */
    uint64_t app;
    /* In the order they were asked for. */
    const gleaner_job_v1 *jobs;
    const gleaner_device_v1 *devices;
    /* At least 1. */
    uint32_t job_count;
    /* At least 1. */
    uint32_t device_count;
    /* The application's task. */
    uint32_t task;
    /* Zero. */
    uint32_t reserved;
} gleaner_batch_v1;

/* A job's place, by positions in the batch's arrays (not by gleaner_job_v1.index or gleaner_device_v1.device). 8 bytes. */
typedef struct gleaner_choice_v1 {
    uint32_t job;
    uint32_t device;
} gleaner_choice_v1;

/* A plug-in. 24 bytes. */
struct gleaner_policy_v1 {
    /* GLEANER_POLICY_ABI_V1. */
    uint32_t abi_version;
    /* sizeof(struct gleaner_policy_v1). */
    uint32_t struct_size;
    /* What it does, for the log: at most 255 bytes of UTF-8 and a zero. */
    const char *about;
    /*
     * Fills choices[0 .. job_count), each job exactly once, in the order in which the jobs should run. Returns 0; any other
     * value says that it does not answer this batch.
     */
    int32_t (*place)(const gleaner_batch_v1 *batch, gleaner_choice_v1 *choices);
};

/* What a plug-in exports. */
#ifdef __GNUC__
__attribute__((visibility("default")))
#endif
extern const struct gleaner_policy_v1 gleaner_policy_v1;

#ifdef __cplusplus
}
#endif

#endif
