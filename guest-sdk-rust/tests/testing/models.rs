//! Tensors and models in the fake host.

use gleaner_sdk::data::Encoding;
use gleaner_sdk::inference::{
    DetectOptions, Detection, ElementType, InferenceError, Model, Preprocess, Tensor,
};
use gleaner_sdk::testing::{FakeModel, Host, Message, Run};
use gleaner_sdk::{Config, Error, Lambda, Result, Sample, event};

use super::lambda::{TestLambda, camera, imu, on_event};

/// An event for each person that a model detects.
struct Person {
    detector: Model,
    options: DetectOptions,
}

impl Lambda for Person {
    fn init(_: &Config) -> Result<Self> {
        let options = DetectOptions { classes: vec!["person".to_owned()], ..Default::default() };
        Ok(Self { detector: Model::open("detector")?, options })
    }

    fn on_event(&mut self, sample: Sample) -> Result<()> {
        for found in self.detector.detect(&sample.as_frame()?, &self.options)? {
            event(&found.label, found.score.into()).send()?;
        }
        Ok(())
    }
}

/// A `[[model]]`; `keys` are further keys.
fn model(keys: &str) -> String {
    let hash = "0".repeat(64);
    format!(
        "[[model]]\nname = \"detector\"\nfile = \"detector.onnx\"\nsha256 = \"{hash}\"\n{keys}\n"
    )
}

fn with_model() -> Host {
    camera(false, &model("layout = \"yolox\""))
}

fn found(class: u32, label: &str, score: f32) -> Detection {
    Detection { class, label: label.to_owned(), score, x: 0.0, y: 0.0, width: 1.0, height: 1.0 }
}

fn picture() -> Message {
    Message::image(2, 1, Encoding::Rgb8, [0; 6])
}

fn refusal<T>(result: Result<T>) -> (String, String) {
    let kind = |error: &Error| error.kind().map(|kind| kind.to_string()).unwrap_or_default();
    result.err().map(|error| (kind(&error), error.to_string())).unwrap_or_default()
}

#[test]
fn a_lambda_gets_the_detections_that_the_test_sets_for_a_frame() {
    let detector = FakeModel::new().detect(|frame| {
        assert_eq!((frame.info.width, frame.stamps.at_ns), (2, frame.identity.seq as i64));
        Ok(match frame.identity.seq {
            1 => vec![found(0, "person", 0.5), found(2, "car", 0.9), found(0, "person", 0.75)],
            2 => vec![found(0, "person", 0.24)],
            _ => return Err(InferenceError::TooSlow("no time is left".to_owned())),
        })
    });
    let mut run: Run<Person> = with_model().model("detector", detector).load().unwrap();
    for at_ns in 1..=3 {
        run.deliver("camera", at_ns, picture()).unwrap();
    }
    let triggers: Vec<_> = run.triggers().map(|trigger| (&*trigger.label, trigger.score)).collect();
    assert_eq!(triggers, [("person", Some(0.75)), ("person", Some(0.5))]);
    let faults: Vec<_> = run.faults().map(|fault| fault.message.as_str()).collect();
    assert_eq!(faults, ["no time is left"]);
}

#[test]
fn options_of_detect_select_by_label_or_index_and_are_checked() {
    let detector = FakeModel::new()
        .labels(["person", "bicycle", "car"])
        .detect(|_| Ok(vec![found(2, "car", 0.9), found(1, "bicycle", 0.8), found(2, "car", 1.0)]));
    let mut run = on_event(with_model().model("detector", detector), |sample| {
        let (model, frame) = (Model::open("detector")?, sample.as_frame()?);
        let detect = |classes: &[&str], options: DetectOptions| {
            let classes = classes.iter().map(|class| (*class).to_owned()).collect();
            model.detect(&frame, &DetectOptions { classes, ..options })
        };
        let scores = |found: Vec<Detection>| found.iter().map(|it| it.score).collect::<Vec<_>>();
        let usual = DetectOptions::default;
        assert_eq!(scores(detect(&[], usual())?), [1.0, 0.9, 0.8]);
        assert_eq!(scores(detect(&["2"], usual())?), [1.0, 0.9]);
        assert_eq!(scores(detect(&["bicycle", "0"], usual())?), [0.8]);
        let one = DetectOptions { max_count: 1, ..usual() };
        assert_eq!(scores(detect(&["car"], one)?), [1.0]);
        for (classes, options, why) in [
            (&["bus"][..], usual(), "model `detector` has no class `bus` in its labels"),
            (
                &[][..],
                DetectOptions { max_iou: f32::NAN, ..usual() },
                "`max_iou` is NaN; its range is 0 to 1",
            ),
        ] {
            assert_eq!(
                refusal(detect(classes, options)),
                ("wrong-input".to_owned(), why.to_owned())
            );
        }
        assert_eq!(model.labels()[2], "car");
        Ok(())
    });
    run.deliver("camera", 0, picture()).unwrap();
    assert_eq!(run.faults().next(), None);
}

#[test]
fn frames_that_no_model_accepts_are_refused() {
    let detector = FakeModel::new().detect(|_| Ok(Vec::new()));
    let mut run = on_event(with_model().model("detector", detector), |sample| {
        let (model, frame) = (Model::open("detector")?, sample.as_frame()?);
        let refused = refusal(model.detect(&frame, &DetectOptions::default()));
        assert_eq!(refused.0, "wrong-input");
        let made = Tensor::from_frame(&frame, Preprocess::new(8, 8));
        assert_eq!(refusal(made), refused);
        Ok(())
    });
    run.deliver("camera", 0, Message::image(1, 1, Encoding::Mono16, [1, 2])).unwrap();
    run.deliver("camera", 1, Message::image(2, 1, Encoding::BayerRggb8, [1, 2])).unwrap();
    assert_eq!(run.faults().next(), None);
}

#[test]
fn a_model_runs_by_a_closure_over_its_inputs() {
    let doubled = FakeModel::new().run(|inputs| {
        let [(name, tensor)] = inputs else {
            return Err(InferenceError::WrongInput("one input is needed".to_owned()));
        };
        let values: Vec<_> = tensor.values::<f32>()?.iter().map(|value| 2.0 * value).collect();
        Ok(vec![(format!("2 {name}"), Tensor::from_values(&tensor.shape(), &values)?)])
    });
    let mut run = on_event(with_model().model("detector", doubled), |_| {
        let model = Model::open("detector")?;
        let tensor = Tensor::from_values(&[1, 2], &[1.5_f32, 4.0])?;
        let outputs = model.run(&[("images", &tensor)])?;
        assert_eq!((outputs.len(), outputs[0].0.as_str()), (1, "2 images"));
        assert_eq!(outputs[0].1.values::<f32>()?, [3.0, 8.0]);
        assert_eq!(refusal(model.run(&[])).0, "wrong-input");
        let frame = DetectOptions::default();
        assert_eq!((model.inputs().len(), frame.max_count), (0, 100));
        Ok(())
    });
    run.deliver("camera", 0, picture()).unwrap();
    assert_eq!(run.faults().next(), None);
}

#[test]
fn a_model_without_answers_names_the_way_out() {
    let kind = |host: Host, name: &'static str| {
        let mut run = on_event(host, move |_| {
            let (kind, why) = refusal(Model::open(name));
            Err(Error::new(format!("{kind}: {why}")))
        });
        run.deliver("camera", 0, picture()).unwrap()[0].fault.clone().unwrap().message
    };
    let unknown = "no-such-model: no model `segments`; the manifest has `detector`";
    assert_eq!(kind(with_model(), "segments"), unknown);
    let unset = "unavailable: the fake host has no answers of model `detector`; set them with \
                 `testing::Host::model`";
    assert_eq!(kind(with_model(), "detector"), unset);
    let refused = with_model().model("segments", FakeModel::new()).load::<TestLambda>().err();
    assert_eq!(
        refused.unwrap().to_string(),
        "no model `segments` for answers\n  help:  the manifest has `detector`"
    );

    let mut run = on_event(with_model().model("detector", FakeModel::new()), |sample| {
        let model = Model::open("detector")?;
        let unset = refusal(model.detect(&sample.as_frame()?, &DetectOptions::default()));
        assert_eq!((&*unset.0, unset.1.contains("FakeModel::detect")), ("unavailable", true));
        let unset = refusal(model.run(&[]));
        assert_eq!((&*unset.0, unset.1.contains("FakeModel::run")), ("unavailable", true));
        Ok(())
    });
    run.deliver("camera", 0, picture()).unwrap();
    assert_eq!(run.faults().next(), None);

    let detector = FakeModel::new().detect(|_| Ok(Vec::new()));
    let host = camera(false, &model("")).model("detector", detector);
    let mut run = host.load::<Person>().unwrap();
    let fault = run.deliver("camera", 0, picture()).unwrap()[0].fault.clone().unwrap();
    assert_eq!(fault.message, "model `detector` has no `layout` in the manifest, for `detect`");
}

#[test]
fn values_of_every_type_return_from_a_tensor() {
    let mut run = on_event(imu("", ""), |_| {
        macro_rules! return_equal {
            ($($element:ident $number:ty: $values:expr;)*) => {$({
                let values: Vec<$number> = $values.to_vec();
                let tensor = Tensor::from_values(&[values.len() as u32], &values)?;
                assert_eq!(tensor.element(), ElementType::$element);
                assert_eq!(tensor.size() as usize, size_of_val(&*values));
                assert_eq!(tensor.values::<$number>()?, values);
            })*};
        }
        return_equal! {
            Float32 f32: [0.5, f32::MIN];
            Float64 f64: [0.1, f64::MAX];
            Int8 i8: [-128, 127];
            Int16 i16: [-2, 300];
            Int32 i32: [i32::MIN, 70_000];
            Int64 i64: [i64::MIN, 1];
            Uint8 u8: [0, 255];
            Boolean bool: [true, false, true];
        }
        // Longer than one piece.
        let long: Vec<i64> = (0..20_000).collect();
        assert_eq!(Tensor::from_values(&[2, 10_000], &long)?.values::<i64>()?, long);
        let scalar = Tensor::from_values(&[], &[7_i32])?;
        assert_eq!((scalar.shape(), scalar.values::<i32>()?), (vec![], vec![7]));
        Ok(())
    });
    run.deliver("imu", 0, Message::new()).unwrap();
    assert_eq!(run.faults().next(), None);
}

#[test]
fn tensors_are_checked_and_take_memory() {
    let mut run = on_event(imu("", "[limits]\nmemory = \"1 MiB\""), |_| {
        let tensor = Tensor::create(ElementType::Float16, &[2, 3])?;
        tensor.write(2, &[1, 2])?;
        assert_eq!((tensor.read(0, 4), tensor.read(10, 99)), (vec![0, 0, 1, 2], vec![0, 0]));
        let wrong = |result, why: &str| {
            assert_eq!(refusal(result), ("wrong-input".to_owned(), why.to_owned()));
        };
        wrong(tensor.values::<f32>().map(drop), "the tensor has float16 elements, not float32");
        wrong(tensor.write(11, &[1, 2]), "2 bytes at offset 11 exceed a tensor of 12 bytes");
        wrong(
            tensor.write(u64::MAX, &[]),
            &format!("0 bytes at offset {} exceed a tensor of 12 bytes", u64::MAX),
        );
        wrong(
            Tensor::from_values(&[2, 2], &[1.0; 5]).map(drop),
            "a tensor of shape [2, 2] cannot have 5 values",
        );
        let new = |shape: &[u32]| Tensor::create(ElementType::Uint8, shape).map(drop);
        wrong(new(&[1; 9]), "a tensor has at most 8 dimensions, not 9");
        wrong(new(&[3, 0]), "a tensor of shape [3, 0] has no elements");
        let largest = Tensor::create(ElementType::Uint8, &[1 << 20]);
        assert_eq!(refusal(largest).0, "wrong-input");
        drop(tensor);
        drop(Tensor::create(ElementType::Uint8, &[1 << 20])?);
        new(&[1 << 20])?;
        assert_eq!(refusal(new(&[u32::MAX; 8])).0, "wrong-input");
        Ok(())
    });
    run.deliver("imu", 0, Message::new()).unwrap();
    assert_eq!(run.faults().next(), None);
}
