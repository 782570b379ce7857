//! Converts between bytes and numbers, and between the types of a model and those of a backend.

use gleaner_protocol::inference::Element;
use half::f16;

use super::BackendError;

/// Reads numbers from little-endian bytes.
pub(super) fn numbers<const SIZE: usize, T>(bytes: &[u8], read: fn([u8; SIZE]) -> T) -> Vec<T> {
    bytes.as_chunks().0.iter().map(|chunk| read(*chunk)).collect()
}

/// Writes numbers as little-endian bytes.
pub(super) fn bytes<const SIZE: usize, T: Copy>(
    numbers: &[T],
    write: fn(T) -> [u8; SIZE],
) -> Vec<u8> {
    let mut bytes = vec![0; numbers.len() * SIZE];
    for (chunk, number) in bytes.as_chunks_mut().0.iter_mut().zip(numbers) {
        *chunk = write(*number);
    }
    bytes
}

/// Reads numbers of any float type as `f32`.
pub(super) fn floats(element: Element, bytes: &[u8]) -> Result<Vec<f32>, BackendError> {
    Ok(match element {
        Element::Float16 => {
            numbers(bytes, f16::from_le_bytes).into_iter().map(f16::to_f32).collect()
        }
        Element::Float64 => {
            let wide = numbers(bytes, f64::from_le_bytes);
            let narrow = wide.into_iter().map(|wide| {
                let narrow = wide as f32;
                let fits = narrow.is_finite() || !wide.is_finite();
                fits.then_some(narrow).ok_or_else(|| out_of_range(element, &wide, "float32"))
            });
            narrow.collect::<Result<_, _>>()?
        }
        _ => numbers(bytes, f32::from_le_bytes),
    })
}

/// Writes `f32` as numbers of any float type.
pub(super) fn from_floats(element: Element, floats: &[f32]) -> Vec<u8> {
    match element {
        Element::Float16 => bytes(floats, |float| f16::from_f32(float).to_le_bytes()),
        Element::Float64 => bytes(floats, |float| f64::from(float).to_le_bytes()),
        _ => bytes(floats, f32::to_le_bytes),
    }
}

/// Reads integers or booleans as `i32`.
pub(super) fn integers(element: Element, bytes: &[u8]) -> Result<Vec<i32>, BackendError> {
    Ok(match element {
        Element::Boolean => bytes.iter().map(|byte| i32::from(*byte)).collect(),
        Element::Int64 => {
            let wide = numbers(bytes, i64::from_le_bytes).into_iter();
            let narrow = wide
                .map(|wide| i32::try_from(wide).map_err(|_| out_of_range(element, &wide, "int32")));
            narrow.collect::<Result<_, _>>()?
        }
        _ => numbers(bytes, i32::from_le_bytes),
    })
}

/// Writes `i32` as integers or booleans.
pub(super) fn from_integers(element: Element, integers: &[i32]) -> Vec<u8> {
    match element {
        Element::Boolean => integers.iter().map(|number| u8::from(*number != 0)).collect(),
        Element::Int64 => bytes(integers, |number| i64::from(number).to_le_bytes()),
        _ => bytes(integers, i32::to_le_bytes),
    }
}

fn out_of_range(element: Element, value: &dyn std::fmt::Display, used: &str) -> BackendError {
    BackendError::new(format_args!(
        "an input of {element} has the value {value}, and this backend computes in {used}"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn floats_survive_where_they_fit_and_are_refused_elsewhere() {
        let values = [0.0, -1.5, 65504.0, f32::INFINITY];
        for element in [Element::Float16, Element::Float32, Element::Float64] {
            let bytes = from_floats(element, &values);
            assert_eq!(bytes.len(), values.len() * element.size());
            assert_eq!(floats(element, &bytes).unwrap(), values, "{element}");
        }
        let refused = floats(Element::Float64, &1e300_f64.to_le_bytes()).unwrap_err();
        assert!(refused.to_string().starts_with("an input of float64 has the value 1000"));
        let infinite = floats(Element::Float64, &f64::NEG_INFINITY.to_le_bytes()).unwrap();
        assert_eq!(infinite, [f32::NEG_INFINITY]);
    }

    #[test]
    fn integers_survive_where_they_fit_and_are_refused_elsewhere() {
        for (element, values) in [
            (Element::Int32, [i32::MIN, -1, i32::MAX]),
            (Element::Int64, [i32::MIN, -1, i32::MAX]),
            (Element::Boolean, [0, 1, 1]),
        ] {
            let bytes = from_integers(element, &values);
            assert_eq!(bytes.len(), values.len() * element.size());
            assert_eq!(integers(element, &bytes).unwrap(), values, "{element}");
        }
        assert_eq!(from_integers(Element::Boolean, &[7, 0]), [1, 0]);
        let refused = integers(Element::Int64, &(1_i64 << 31).to_le_bytes()).unwrap_err();
        assert_eq!(
            refused.to_string(),
            "an input of int64 has the value 2147483648, and this backend computes in int32"
        );
    }
}
