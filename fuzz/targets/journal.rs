//! See `gleaner_fuzz::journal`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    gleaner_fuzz::journal::check(data);
});
