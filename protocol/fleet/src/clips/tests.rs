use super::*;

#[test]
fn a_name_is_safe_as_a_part_of_a_path() {
    assert!("brake-20260802T083451.136Z".parse::<ClipName>().is_ok());
    for bad in ["", ".", "..", ".hidden", "a/b", "a\\b", "a\0b", "a b", "ä", &"a".repeat(201)] {
        assert!(bad.parse::<ClipName>().is_err(), "{bad}");
        assert!(format!("{bad}@car-7").parse::<ClipId>().is_err(), "{bad}");
        assert!(format!("clip@{bad}").parse::<ClipId>().is_err(), "{bad}");
    }
    let id: ClipId = "brake-1@car-7".parse().unwrap();
    assert_eq!((id.name(), id.vehicle(), &*id.to_string()), ("brake-1", "car-7", "brake-1@car-7"));
}

#[test]
fn pieces_end_with_the_file() {
    let bytes = 2 * CLIP_PART + 5;
    let length = |begin| ClipFacts::piece_length(bytes, begin);
    assert_eq!([0, 1, CLIP_PART + 5].map(length), [Some(CLIP_PART); 3]);
    assert_eq!([bytes - 5, bytes - 1].map(length), [Some(5), Some(1)]);
    assert_eq!([bytes, u64::MAX].map(length), [None; 2]);
}

fn facts() -> ClipFacts {
    let text = r#"{"name":"a","from_ns":1,"to_ns":2,"bytes":3,"sha256":null,"thumbnail":null,
        "lambdas":[],"triggers":1,"moments":[{"lambda":"l","kind":"event","label":"x",
        "score":null,"attributes":null,"at_ns":1}]}"#;
    serde_json::from_str(text).unwrap()
}

#[test]
fn facts_are_bounded_and_long_ones_are_shortened_until_they_fit() {
    assert_eq!(facts().check(), Ok(()));
    let bad = [
        ClipFacts { bytes: CLIP_MAX + 1, ..facts() },
        ClipFacts { to_ns: 0, ..facts() },
        ClipFacts { sha256: Some("x".repeat(64)), ..facts() },
        ClipFacts { moments: vec![facts().moments[0].clone(); 257], ..facts() },
    ];
    for facts in bad {
        assert!(facts.check().is_err(), "{facts:?}");
    }
    let mut long = facts();
    long.moments[0].label = "é".repeat(400);
    let attributes = Map::from_iter([("text".to_owned(), "y".repeat(4000).into())]);
    long.moments[0].attributes = Some(attributes);
    long.moments = vec![long.moments[0].clone(); 300];
    assert!(long.check().is_err());
    long.shorten();
    assert_eq!(long.check(), Ok(()));
    assert!(serde_json::to_vec(&long).unwrap().len() <= CLIP_FACTS_MAX);
    assert!(!long.moments.is_empty());
    long.moments[0].attributes =
        Some(Map::from_iter([("text".to_owned(), "y".repeat(70_000).into())]));
    assert!(long.check().is_err());
}
