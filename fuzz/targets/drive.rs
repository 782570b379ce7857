//! See `gleaner_fuzz::drive`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    gleaner_fuzz::drive::check(data);
});
