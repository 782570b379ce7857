//! Kernels of the SDK: what they compute in a component is what the same source computes natively.

use gleaner_tests::drive::{Cdr, one_topic};
use gleaner_tests::{Folder, replay, root};

const IMU: &str = "std_msgs/Header header\n\
================================================================================\n\
MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n\
================================================================================\n\
MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";

#[test]
fn a_component_computes_what_the_same_source_computes_natively() {
    let folder = Folder::new();
    let drive =
        one_topic(&folder, "/imu/data", "sensor_msgs/msg/Imu", IMU, &[(1, Cdr::header().done())]);
    let run = replay(&root().join("tests/lambdas/kernels/rust"), &[drive], &[]);
    let found = &run.must_exit(0).decisions[0].triggers;
    let expected = kernels::results().unwrap();
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(&expected) {
        // All of it in integers, or in sums of a fixed order, is equal.
        assert_eq!(found.label, format!("{} {:016x}", expected.kernel, expected.digest));
        // Sine and cosine come from other libraries, so spectra are nearly equal.
        let nearly = if expected.kernel.ends_with("f32") { 1e-6 } else { 1e-14 };
        let off = (found.score.unwrap() - expected.number).abs();
        assert!(
            off <= nearly * expected.number,
            "{}: {:?}, natively {}",
            found.label,
            found.score,
            expected.number
        );
    }
}

#[test]
fn components_are_built_with_vectors_of_128_bits_and_without_relaxed_ones() {
    let component =
        std::fs::read(root().join("tests/lambdas/kernels/rust/build/kernels.wasm")).unwrap();
    // The compiler lists what it used in a section of the module: a plus, the length of a name, the
    // name.
    let has = |feature: &[u8]| component.windows(feature.len()).any(|bytes| bytes == feature);
    assert!(has(b"+\x07simd128"));
    assert!(!has(b"+\x0crelaxed-simd"));
}
