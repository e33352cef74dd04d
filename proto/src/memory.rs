//! What the C library's allocator is told: Rust's own interface to it has no such switch.

#![allow(unsafe_code, reason = "mallopt(3) is a C function; audited here")]

/// For a daemon's start. glibc maps blocks from some size on by themselves, and raises that size to each such block that is freed, up to
/// 32 MiB (mallopt(3), `M_MMAP_THRESHOLD`); later ones stay in its arenas, with holes between them. A daemon that had a few large
/// messages or frames at a time would keep a multiple of them for good. A fixed size makes it give their buffers back as they are
/// freed, and lets them grow without a copy. Who sets `MALLOC_MMAP_THRESHOLD_` has chosen already.
pub fn give_large_blocks_back() {
    #[cfg(all(target_os = "linux", target_env = "gnu"))]
    {
        /// Pieces of contents are smaller: there are many, and they are as good as new.
        const MAPPED_BYTES: i32 = 4 << 20;
        /// Free bytes that an arena keeps at its end: twice as many, as where glibc chooses by itself.
        const KEPT_BYTES: i32 = 2 * MAPPED_BYTES;
        if std::env::var_os("MALLOC_MMAP_THRESHOLD_").is_some() {
            return;
        }
        // SAFETY: mallopt may be called at any time, and changes what later calls of the allocator do.
        let set = unsafe {
            libc::mallopt(libc::M_MMAP_THRESHOLD, MAPPED_BYTES)
                & libc::mallopt(libc::M_TRIM_THRESHOLD, KEPT_BYTES)
        };
        if set == 0 {
            tracing::warn!(
                "the allocator takes no thresholds: memory of large messages may stay with the process"
            );
        }
    }
}
