//! Converts between bytes and numbers, and between the types of a model and those of a backend.

use std::borrow::Cow;

use gleaner_protocol::inference::Element;
use half::f16;
use zerocopy::{FromBytes, Immutable, IntoBytes};

use super::BackendError;

// The interface has little-endian numbers, as have all CPUs that Gleaner supports.
const _: () = assert!(cfg!(target_endian = "little"));

/// Reads numbers from bytes: in place, or from a copy if they are not aligned.
pub(super) fn numbers<T: FromBytes + Immutable + Copy>(bytes: &[u8]) -> Cow<'_, [T]> {
    match <[T]>::ref_from_bytes(bytes) {
        Ok(numbers) => Cow::Borrowed(numbers),
        Err(_) => {
            let chunks = bytes.chunks_exact(size_of::<T>());
            Cow::Owned(chunks.filter_map(|chunk| T::read_from_bytes(chunk).ok()).collect())
        }
    }
}

pub(super) fn bytes<T: IntoBytes + Immutable>(numbers: &[T]) -> Vec<u8> {
    numbers.as_bytes().to_vec()
}

/// Reads numbers of any float type as `f32`.
pub(super) fn floats(element: Element, bytes: &[u8]) -> Result<Cow<'_, [f32]>, BackendError> {
    Ok(match element {
        Element::Float16 => numbers(bytes).iter().copied().map(f16::to_f32).collect(),
        Element::Float64 => {
            let wide = numbers(bytes);
            let narrow = wide.iter().copied().map(|wide: f64| {
                let narrow = wide as f32;
                let fits = narrow.is_finite() || !wide.is_finite();
                fits.then_some(narrow).ok_or_else(|| out_of_range(element, &wide, "float32"))
            });
            narrow.collect::<Result<_, _>>()?
        }
        _ => numbers(bytes),
    })
}

/// Writes `f32` as numbers of any float type.
pub(super) fn from_floats(element: Element, floats: &[f32]) -> Vec<u8> {
    let floats_of = floats.iter().copied();
    match element {
        Element::Float16 => bytes(&floats_of.map(f16::from_f32).collect::<Vec<_>>()),
        Element::Float64 => bytes(&floats_of.map(f64::from).collect::<Vec<_>>()),
        _ => bytes(floats),
    }
}

/// Reads integers or booleans as `i32`.
pub(super) fn integers(element: Element, bytes: &[u8]) -> Result<Cow<'_, [i32]>, BackendError> {
    Ok(match element {
        Element::Boolean => bytes.iter().map(|byte| i32::from(*byte)).collect(),
        Element::Int64 => {
            let wide = numbers(bytes);
            let narrow = wide.iter().copied().map(|wide: i64| {
                i32::try_from(wide).map_err(|_| out_of_range(element, &wide, "int32"))
            });
            narrow.collect::<Result<_, _>>()?
        }
        _ => numbers(bytes),
    })
}

/// Writes `i32` as integers or booleans.
pub(super) fn from_integers(element: Element, integers: &[i32]) -> Vec<u8> {
    match element {
        Element::Boolean => integers.iter().map(|number| u8::from(*number != 0)).collect(),
        Element::Int64 => bytes(&integers.iter().copied().map(i64::from).collect::<Vec<_>>()),
        _ => bytes(integers),
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
            assert_eq!(*floats(element, &bytes).unwrap(), values, "{element}");
        }
        let refused = floats(Element::Float64, &1e300_f64.to_le_bytes()).unwrap_err();
        assert!(refused.to_string().starts_with("an input of float64 has the value 1000"));
        let infinite = f64::NEG_INFINITY.to_le_bytes();
        assert_eq!(*floats(Element::Float64, &infinite).unwrap(), [f32::NEG_INFINITY]);
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
            assert_eq!(*integers(element, &bytes).unwrap(), values, "{element}");
        }
        assert_eq!(from_integers(Element::Boolean, &[7, 0]), [1, 0]);
        let refused = integers(Element::Int64, &(1_i64 << 31).to_le_bytes()).unwrap_err();
        assert_eq!(
            refused.to_string(),
            "an input of int64 has the value 2147483648, and this backend computes in int32"
        );
    }
}
