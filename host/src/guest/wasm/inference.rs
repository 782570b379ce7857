//! `gleaner:lambda/inference` over [`api::inference`](crate::api::inference).

use gleaner_pixels::vision;
use gleaner_protocol::inference as protocol;
use wasmtime::component::Resource;

use super::Hosted;
use super::bindings::gleaner::lambda::inference::{
    DetectOptions, Detection, ElementType, Host, HostModel, HostTensor, InferenceError, Preprocess,
    TensorInfo,
};
use super::bindings::gleaner::lambda::types::Placement;
use crate::api::frame::Frame;
use crate::api::inference::{self, InferenceErrorKind as Kind, Model, Tensor};

type InferenceResult<T> = wasmtime::Result<Result<T, InferenceError>>;

impl Host for Hosted {}

impl HostTensor for Hosted {
    fn create(
        &mut self,
        element: ElementType,
        shape: Vec<u32>,
    ) -> InferenceResult<Resource<Tensor>> {
        let created = self.session.tensors().create(element_in(element), &shape);
        self.push_model_result(created)
    }

    fn from_frame(
        &mut self,
        frame: Resource<Frame>,
        how: Preprocess,
    ) -> InferenceResult<Resource<Tensor>> {
        let (session, frame) = (self.session.clone(), self.handles.get(&frame)?);
        let tensor = session.tensors().of_frame(session.models(), frame, &preprocess(how));
        self.push_model_result(tensor)
    }

    fn element(&mut self, tensor: Resource<Tensor>) -> wasmtime::Result<ElementType> {
        Ok(element_out(self.resolve(&tensor)?.content().element))
    }

    fn shape(&mut self, tensor: Resource<Tensor>) -> wasmtime::Result<Vec<u32>> {
        Ok(self.resolve(&tensor)?.content().shape.clone())
    }

    fn size(&mut self, tensor: Resource<Tensor>) -> wasmtime::Result<u64> {
        Ok(self.resolve(&tensor)?.content().bytes.len() as u64)
    }

    fn read(
        &mut self,
        tensor: Resource<Tensor>,
        offset: u64,
        len: u32,
    ) -> wasmtime::Result<Vec<u8>> {
        Ok(self.handles.get(&tensor)?.read(offset, len)?.to_vec())
    }

    fn write(
        &mut self,
        tensor: Resource<Tensor>,
        offset: u64,
        bytes: Vec<u8>,
    ) -> InferenceResult<()> {
        wit_result(self.handles.get_mut(&tensor)?.write(offset, &bytes))
    }

    fn drop(&mut self, tensor: Resource<Tensor>) -> wasmtime::Result<()> {
        self.handles.delete(tensor)?;
        Ok(())
    }
}

impl HostModel for Hosted {
    fn open(&mut self, name: String) -> InferenceResult<Resource<Model>> {
        let opened = Model::open(self.session.models(), self.session.tensors(), &name);
        self.push_model_result(opened)
    }

    fn inputs(&mut self, model: Resource<Model>) -> wasmtime::Result<Vec<TensorInfo>> {
        Ok(self.resolve(&model)?.inputs().iter().map(info).collect())
    }

    fn outputs(&mut self, model: Resource<Model>) -> wasmtime::Result<Vec<TensorInfo>> {
        Ok(self.resolve(&model)?.outputs().iter().map(info).collect())
    }

    fn labels(&mut self, model: Resource<Model>) -> wasmtime::Result<Vec<String>> {
        Ok(self.resolve(&model)?.labels().to_vec())
    }

    fn runtime(&mut self, model: Resource<Model>) -> wasmtime::Result<String> {
        Ok(self.resolve(&model)?.runtime().to_owned())
    }

    fn run(
        &mut self,
        model: Resource<Model>,
        inputs: Vec<(String, Resource<Tensor>)>,
    ) -> InferenceResult<Vec<(String, Resource<Tensor>)>> {
        let mut named = Vec::new();
        for (name, tensor) in inputs {
            named.push((name, self.handles.get(&tensor)?.content().clone()));
        }
        let outputs = match wit_result(self.handles.get(&model)?.run(&named))? {
            Ok(outputs) => outputs,
            Err(error) => return Ok(Err(error)),
        };
        let push = |(name, tensor)| Ok((name, self.handles.push(tensor)?));
        outputs.into_iter().map(push).collect::<wasmtime::Result<_>>().map(Ok)
    }

    fn detect(
        &mut self,
        model: Resource<Model>,
        frame: Resource<Frame>,
        options: DetectOptions,
    ) -> InferenceResult<Vec<Detection>> {
        let (model, frame) = (self.handles.get(&model)?, self.handles.get(&frame)?);
        let DetectOptions { classes, min_score, max_iou, max_count } = options;
        let options = inference::DetectOptions { classes, min_score, max_iou, max_count };
        let detection = |found: vision::Detection| {
            let vision::Detection { class, score, x, y, width, height } = found;
            Detection { class, label: model.label(class), score, x, y, width, height }
        };
        let detected = model.detect(frame, &options);
        wit_result(detected.map(|found| found.into_iter().map(detection).collect()))
    }

    fn drop(&mut self, model: Resource<Model>) -> wasmtime::Result<()> {
        self.handles.delete(model)?;
        Ok(())
    }
}

impl Hosted {
    fn push_model_result<T: Send + 'static>(
        &mut self,
        result: Result<T, inference::InferenceError>,
    ) -> InferenceResult<Resource<T>> {
        match wit_result(result)? {
            Ok(value) => Ok(Ok(self.handles.push(value)?)),
            Err(error) => Ok(Err(error)),
        }
    }
}

/// Converts a result for the guest. Errors for lack of fuel or time end the guest.
fn wit_result<T>(result: Result<T, inference::InferenceError>) -> InferenceResult<T> {
    let error = match result {
        Ok(value) => return Ok(Ok(value)),
        Err(inference::InferenceError::OutOfFuel(error)) => return Err(error.into()),
        Err(inference::InferenceError::OutOfTime) => {
            return Err(crate::api::data::DataError::OutOfTime.into());
        }
        Err(error) => error,
    };
    let message = error.to_string();
    Ok(Err(match error.kind() {
        Kind::Unavailable => InferenceError::Unavailable(message),
        Kind::NoSuchModel => InferenceError::NoSuchModel(message),
        Kind::WrongInput => InferenceError::WrongInput(message),
        Kind::TooSlow => InferenceError::TooSlow(message),
        Kind::Failed => InferenceError::Failed(message),
    }))
}

fn info(protocol::TensorInfo { name, element, shape }: &protocol::TensorInfo) -> TensorInfo {
    TensorInfo { name: name.clone(), element: element_out(*element), shape: shape.clone() }
}

fn element_in(element: ElementType) -> protocol::Element {
    use protocol::Element as E;
    match element {
        ElementType::Float32 => E::Float32,
        ElementType::Float16 => E::Float16,
        ElementType::Float64 => E::Float64,
        ElementType::Int8 => E::Int8,
        ElementType::Int16 => E::Int16,
        ElementType::Int32 => E::Int32,
        ElementType::Int64 => E::Int64,
        ElementType::Uint8 => E::Uint8,
        ElementType::Boolean => E::Boolean,
    }
}

fn element_out(element: protocol::Element) -> ElementType {
    use protocol::Element as E;
    match element {
        E::Float32 => ElementType::Float32,
        E::Float16 => ElementType::Float16,
        E::Float64 => ElementType::Float64,
        E::Int8 => ElementType::Int8,
        E::Int16 => ElementType::Int16,
        E::Int32 => ElementType::Int32,
        E::Int64 => ElementType::Int64,
        E::Uint8 => ElementType::Uint8,
        E::Boolean => ElementType::Boolean,
    }
}

fn preprocess(how: Preprocess) -> vision::Preprocess {
    let Preprocess { width, height, fill, bgr, channels_last, bytes, scale, .. } = how;
    let placement = match how.placement {
        Placement::Stretch => vision::Placement::Stretch,
        Placement::Centre => vision::Placement::Centre,
        Placement::Corner => vision::Placement::Corner,
    };
    let (mean, deviation) = (how.mean.into(), how.deviation.into());
    vision::Preprocess {
        width,
        height,
        placement,
        fill,
        bgr,
        channels_last,
        bytes,
        scale,
        mean,
        deviation,
    }
}
