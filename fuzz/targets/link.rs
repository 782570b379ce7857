//! See `gleaner_fuzz::link`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    gleaner_fuzz::link::check(data);
});
