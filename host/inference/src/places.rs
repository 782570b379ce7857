//! Checks the places of tensors in shared memory. Pure functions: they trust no number of a lambda.

use gleaner_protocol::inference::{
    Element, MAX_TENSOR_BYTES, TENSOR_ALIGNMENT, TensorInfo, TensorPlace,
};

/// A checked input, to copy out of the region.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PlacedInput {
    pub element: Element,
    pub shape: Vec<u32>,
    /// Offset of its first byte in the region.
    pub offset: u64,
    /// Size in bytes, at most [`MAX_TENSOR_BYTES`].
    pub bytes: u64,
}

/// The reason why a request does not fit its model.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum PlaceError {
    #[error("the model has no input `{name}`; its inputs are {known}")]
    Unknown { name: String, known: String },
    #[error("input `{name}` is missing")]
    Missing { name: String },
    #[error("input `{name}` is given twice")]
    Twice { name: String },
    #[error("input `{name}` is {found}, and the model needs {needed}")]
    Unfit { name: String, found: String, needed: String },
    #[error("input `{name}` has too many dimensions, a length of 0, or too many bytes")]
    Size { name: String },
    #[error("the inputs have {bytes} bytes; {MAX_TENSOR_BYTES} are allowed")]
    TooLarge { bytes: u64 },
    #[error(
        "input `{name}` begins at offset {offset}, which is not a multiple of {TENSOR_ALIGNMENT}"
    )]
    Unaligned { name: String, offset: u64 },
    #[error(
        "input `{name}` has {bytes} bytes at offset {offset}, beyond the {region} bytes of the \
         region"
    )]
    Outside { name: String, bytes: u64, offset: u64, region: u64 },
}

/// Checks the inputs of a run against those that the model needs, and against the region of
/// `region_bytes`. Returns them in the order of the model.
pub fn check_inputs(
    needed: &[TensorInfo],
    given: &[TensorPlace],
    region_bytes: u64,
) -> Result<Vec<PlacedInput>, PlaceError> {
    if let Some(unknown) = given.iter().find(|it| needed.iter().all(|info| info.name != it.name)) {
        let known: Vec<String> = needed.iter().map(|info| format!("`{}`", info.name)).collect();
        return Err(PlaceError::Unknown { name: unknown.name.clone(), known: known.join(", ") });
    }
    let placed = needed.iter().map(|info| {
        let mut places = given.iter().filter(|place| place.name == info.name);
        let name = || info.name.clone();
        let place = places.next().ok_or_else(|| PlaceError::Missing { name: name() })?;
        if places.next().is_some() {
            return Err(PlaceError::Twice { name: name() });
        }
        check_input(info, place, region_bytes)
    });
    let placed: Vec<PlacedInput> = placed.collect::<Result<_, _>>()?;
    // Inputs may share bytes of the region, but each is copied.
    let bytes = placed.iter().map(|input| input.bytes).sum();
    if bytes > MAX_TENSOR_BYTES {
        return Err(PlaceError::TooLarge { bytes });
    }
    Ok(placed)
}

fn check_input(
    info: &TensorInfo,
    place: &TensorPlace,
    region_bytes: u64,
) -> Result<PlacedInput, PlaceError> {
    let TensorPlace { element, shape, offset, .. } = place;
    let (name, offset) = (|| info.name.clone(), *offset);
    // First the size: it bounds the number of dimensions, and with it the message below.
    let bytes = place.bytes().filter(|bytes| *bytes > 0);
    let bytes = bytes.ok_or_else(|| PlaceError::Size { name: name() })?;
    if !info.accepts(*element, shape) {
        let shape = shape.iter().map(|length| Some(*length)).collect();
        let found = TensorInfo { name: name(), element: *element, shape };
        let (found, needed) = (found.to_string(), info.to_string());
        return Err(PlaceError::Unfit { name: name(), found, needed });
    }
    if !offset.is_multiple_of(TENSOR_ALIGNMENT) {
        return Err(PlaceError::Unaligned { name: name(), offset });
    }
    if offset.checked_add(bytes).is_none_or(|end| end > region_bytes) {
        return Err(PlaceError::Outside { name: name(), bytes, offset, region: region_bytes });
    }
    Ok(PlacedInput { element: *element, shape: shape.clone(), offset, bytes })
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the outputs have more than {MAX_TENSOR_BYTES} bytes")]
pub struct OutputsTooLarge;

/// Places outputs one after another. Returns their places, and the size of the region.
pub fn place_outputs<'a>(
    outputs: impl Iterator<Item = (&'a str, Element, &'a [u32])>,
) -> Result<(Vec<TensorPlace>, u64), OutputsTooLarge> {
    let (mut places, mut end) = (Vec::new(), 0_u64);
    for (name, element, shape) in outputs {
        let bytes = element.bytes_of(shape).ok_or(OutputsTooLarge)?;
        let offset = end.next_multiple_of(TENSOR_ALIGNMENT);
        end = offset + bytes;
        if end > MAX_TENSOR_BYTES {
            return Err(OutputsTooLarge);
        }
        let (name, shape) = (name.to_owned(), shape.to_vec());
        places.push(TensorPlace { name, element, shape, offset });
    }
    Ok((places, end))
}

#[cfg(test)]
mod tests {
    use super::*;

    const F32: Element = Element::Float32;

    fn info(name: &str, shape: &[Option<u32>]) -> TensorInfo {
        TensorInfo { name: name.to_owned(), element: F32, shape: shape.to_vec() }
    }

    fn place(name: &str, shape: &[u32], offset: u64) -> TensorPlace {
        TensorPlace { name: name.to_owned(), element: F32, shape: shape.to_vec(), offset }
    }

    fn refusal(given: &[TensorPlace]) -> String {
        let needed = [info("a", &[Some(2), None]), info("b", &[])];
        check_inputs(&needed, given, 1024).unwrap_err().to_string()
    }

    #[test]
    fn inputs_are_returned_in_the_order_of_the_model() {
        let needed = [info("a", &[Some(2), None]), info("b", &[])];
        let given = [place("b", &[], 64), place("a", &[2, 3], 1024 - 64)];
        let placed = check_inputs(&needed, &given, 1024).unwrap();
        let found: Vec<_> = placed.iter().map(|input| (input.offset, input.bytes)).collect();
        assert_eq!(found, [(960, 24), (64, 4)]);
        assert_eq!(check_inputs(&[], &[], 0), Ok(Vec::new()));
    }

    #[test]
    fn wrong_names_types_and_shapes_are_refused_with_both_shapes() {
        let b = || place("b", &[], 0);
        assert_eq!(refusal(&[b()]), "input `a` is missing");
        assert_eq!(refusal(&[b(), b(), place("a", &[2, 1], 0)]), "input `b` is given twice");
        assert_eq!(
            refusal(&[b(), place("c", &[2], 0)]),
            "the model has no input `c`; its inputs are `a`, `b`"
        );
        assert_eq!(
            refusal(&[b(), place("a", &[3, 640], 0)]),
            "input `a` is float32 [3, 640], and the model needs float32 [2, ?]"
        );
        let int8 = TensorPlace { element: Element::Int8, ..place("a", &[2, 3], 0) };
        assert_eq!(
            refusal(&[b(), int8]),
            "input `a` is int8 [2, 3], and the model needs float32 [2, ?]"
        );
    }

    #[test]
    fn hostile_offsets_and_lengths_are_refused() {
        let a = |shape: &[u32], offset| refusal(&[place("a", shape, offset), place("b", &[], 0)]);
        let size = "input `a` has too many dimensions, a length of 0, or too many bytes";
        for shape in [&[2, 0][..], &[2, u32::MAX], &[u32::MAX; 8], &[1; 9], &[1; 4000]] {
            assert_eq!(a(shape, 0), size);
        }
        assert!(a(&[2, 1], 4).contains("not a multiple of 64"));
        for offset in [1024, 1024 - 64, u64::MAX - 63, 1 << 63] {
            assert!(a(&[2, 9], offset).contains("beyond the 1024 bytes"), "{offset}");
        }
        let large = [info("a", &[None]), info("b", &[None])];
        let most = (MAX_TENSOR_BYTES / 4) as u32;
        let given = [place("a", &[most], 0), place("b", &[1], 0)];
        let refused = check_inputs(&large, &given, MAX_TENSOR_BYTES).unwrap_err();
        assert!(matches!(refused, PlaceError::TooLarge { .. }), "{refused}");
    }

    #[test]
    fn outputs_lie_one_after_another_at_multiples_of_64() {
        let outputs = [("a", F32, &[3_u32][..]), ("b", Element::Boolean, &[65]), ("c", F32, &[])];
        let (places, bytes) = place_outputs(outputs.into_iter()).unwrap();
        let offsets: Vec<_> = places.iter().map(|place| place.offset).collect();
        assert_eq!((offsets, bytes), (vec![0, 64, 192], 196));
        let empty = place_outputs([("boxes", F32, &[0_u32, 4][..])].into_iter()).unwrap();
        assert_eq!((empty.0[0].offset, empty.1), (0, 0));
        let huge = [("a", F32, &[1 << 26][..]), ("b", F32, &[1])];
        assert_eq!(place_outputs(huge.into_iter()), Err(OutputsTooLarge));
    }
}
