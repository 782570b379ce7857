//! Names clips: `hello-20180802T083451.136Z`.

use gleaner_base::UtcTime;

/// The lambda that triggered, and the time in UTC with milliseconds.
pub fn clip_name(lambda: &str, at_ns: i64) -> String {
    let (seconds, nanoseconds) = (at_ns.div_euclid(1_000_000_000), at_ns.rem_euclid(1_000_000_000));
    let UtcTime { year, month, day, hour, minute, second } = UtcTime::of(seconds);
    let millisecond = nanoseconds / 1_000_000;
    format!(
        "{lambda}-{year:04}{month:02}{day:02}T{hour:02}{minute:02}{second:02}.{millisecond:03}Z"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_clip_is_named_by_its_lambda_and_moment() {
        assert_eq!(clip_name("hello", 1_533_198_891_136_999_999), "hello-20180802T083451.136Z");
        assert_eq!(clip_name("x", 0), "x-19700101T000000.000Z");
        assert_eq!(clip_name("x", i64::MAX), "x-22620411T234716.854Z");
    }
}
