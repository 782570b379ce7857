//! See `gleaner_fuzz::ingress`.
#![no_main]

libfuzzer_sys::fuzz_target!(|data: &[u8]| {
    gleaner_fuzz::ingress::check(data);
});
