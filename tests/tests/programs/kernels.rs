//! Kernels of the SDK compute the same in a component as natively.

use gleaner_tests::drive::{CdrBuilder, one_topic};
use gleaner_tests::{TempFolder, replay, root, with_header};

const IMU: &str = with_header!("std_msgs/Header header\n");

#[test]
fn a_component_computes_the_same_as_native_code() {
    let folder = TempFolder::new();
    let drive = one_topic(
        &folder,
        "/imu/data",
        "sensor_msgs/msg/Imu",
        IMU,
        &[(1, CdrBuilder::header().done())],
    );
    let run = replay(&root().join("tests/lambdas/kernels/rust"), &[drive], &[]);
    let found = &run.must_exit(0).decisions[0].triggers;
    let expected = kernels::results().unwrap();
    assert_eq!(found.len(), expected.len());
    for (found, expected) in found.iter().zip(&expected) {
        // Integers, and sums of a fixed order, are equal.
        assert_eq!(found.label, format!("{} {:016x}", expected.kernel, expected.digest));
        // Sine and cosine come from different libraries, so spectra are only nearly equal.
        let tolerance = if expected.kernel.ends_with("f32") { 1e-6 } else { 1e-14 };
        let difference = (found.score.unwrap() - expected.number).abs();
        assert!(
            difference <= tolerance * expected.number,
            "{}: {:?}, natively {}",
            found.label,
            found.score,
            expected.number
        );
    }
}

#[test]
fn components_use_128_bit_vectors_but_not_relaxed_simd() {
    let component =
        std::fs::read(root().join("tests/lambdas/kernels/rust/build/kernels.wasm")).unwrap();
    // The compiler lists the used features in a section of the module: a plus, the length of the
    // name, the name.
    let has = |feature: &[u8]| component.windows(feature.len()).any(|bytes| bytes == feature);
    assert!(has(b"+\x07simd128"));
    assert!(!has(b"+\x0crelaxed-simd"));
}
