//! Reads a compiled module's interface in two ways: with naga, and from the instructions, since naga
//! drops `readonly` and `writeonly`.

use rspirv::dr::{Instruction, Module, Operand};
use rspirv::spirv::{Capability, Decoration, ExecutionMode, Op, StorageClass, Word};
use splat4d::gpu::{Access, ConstantValue};
use std::collections::{BTreeMap, HashMap};

/// The interface of a module.
#[derive(Debug, Default, PartialEq)]
pub struct Interface {
    /// By binding number.
    pub bindings: BTreeMap<u32, Storage>,
    /// Offset and size in bytes of each push constant; empty if the module uses none.
    pub params: Vec<(u32, u32)>,
    pub workgroup: [u32; 3],
    /// Specialisation constants, by id.
    pub constants: BTreeMap<u32, Constant>,
}

/// One specialisation constant.
#[derive(Clone, Debug, PartialEq)]
pub struct Constant {
    /// `None` if the module has no names.
    pub name: Option<String>,
    /// The default, with its type.
    pub default: ConstantValue,
}

/// One storage buffer.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Storage {
    /// Stride between elements in bytes, or the size of the whole block if it is not an array.
    pub stride: u32,
    /// `None` if the reader cannot determine it.
    pub access: Option<Access>,
}

/// A module's demands on the device, besides its interface.
#[derive(Debug)]
pub struct Demands {
    pub capabilities: Vec<Capability>,
    /// Bytes of shared memory.
    pub shared: u32,
}

/// Reads a module with naga's SPIR-V front end.
pub fn by_naga(spirv: &[u8]) -> Result<Interface, String> {
    let options = naga::front::spv::Options::default();
    // Some modules make the front end panic.
    let module = std::panic::catch_unwind(|| naga::front::spv::parse_u8_slice(spirv, &options))
        .map_err(|_| "the front end panicked".to_string())?
        .map_err(|error| error.to_string())?;
    let mut interface = Interface::default();
    let [entry] = module.entry_points.as_slice() else {
        return Err(format!("{} entry points", module.entry_points.len()));
    };
    interface.workgroup = entry.workgroup_size;
    for (_, variable) in module.global_variables.iter() {
        let inner = &module.types[variable.ty].inner;
        match variable.space {
            naga::AddressSpace::Storage { .. } => {
                let binding = variable.binding.as_ref().ok_or("a buffer without a binding")?;
                if binding.group != 0 {
                    return Err(format!("binding {} is in set {}", binding.binding, binding.group));
                }
                let storage = Storage { stride: naga_stride(&module, inner)?, access: None };
                interface.insert(binding.binding, storage)?;
            }
            naga::AddressSpace::Immediate => {
                let naga::TypeInner::Struct { members, .. } = inner else {
                    return Err("the push constants are no block".into());
                };
                let size = |ty| module.types[ty].inner.size(module.to_ctx());
                interface.params = members.iter().map(|m| (m.offset, size(m.ty))).collect();
            }
            _ => {}
        }
    }
    for (_, constant) in module.overrides.iter() {
        let id = constant.id.ok_or("a specialisation constant without an id")?;
        let default = match constant.init.map(|init| &module.global_expressions[init]) {
            Some(&naga::Expression::Literal(naga::Literal::Bool(value))) => {
                ConstantValue::Bool(value)
            }
            Some(&naga::Expression::Literal(naga::Literal::U32(value))) => {
                ConstantValue::U32(value)
            }
            Some(&naga::Expression::Literal(naga::Literal::I32(value))) => {
                ConstantValue::I32(value)
            }
            Some(&naga::Expression::Literal(naga::Literal::F32(value))) => {
                ConstantValue::F32(value)
            }
            other => return Err(format!("specialisation constant {id} has the default {other:?}")),
        };
        let name = constant.name.clone();
        interface.insert_constant(u32::from(id), Constant { name, default })?;
    }
    Ok(interface)
}

fn naga_stride(module: &naga::Module, inner: &naga::TypeInner) -> Result<u32, String> {
    let naga::TypeInner::Struct { members, span } = inner else {
        return Err("a buffer that is no block".into());
    };
    let last = members.last().ok_or("an empty block")?;
    match &module.types[last.ty].inner {
        naga::TypeInner::Array { stride, size: naga::ArraySize::Dynamic, .. } => {
            if members.len() == 1 { Ok(*stride) } else { Err(MIXED.into()) }
        }
        _ => Ok(*span),
    }
}

const MIXED: &str = "a block with members before its array: one buffer holds one kind of element";

impl Interface {
    fn insert(&mut self, binding: u32, storage: Storage) -> Result<(), String> {
        match self.bindings.insert(binding, storage) {
            None => Ok(()),
            Some(_) => Err(format!("two buffers at binding {binding}")),
        }
    }

    fn insert_constant(&mut self, id: u32, constant: Constant) -> Result<(), String> {
        match self.constants.insert(id, constant) {
            None => Ok(()),
            Some(_) => Err(format!("two specialisation constants have the id {id}")),
        }
    }
}

/// Reads a module instruction by instruction.
pub fn by_rspirv(spirv: &[u8]) -> Result<(Interface, Demands), String> {
    let module = rspirv::dr::load_bytes(spirv).map_err(|error| error.to_string())?;
    let reader = Reader::new(&module);
    let mut interface = Interface::default();
    let mut shared = 0;
    let local_size =
        module.execution_modes.iter().find_map(|mode| match mode.operands.as_slice() {
            [_, Operand::ExecutionMode(ExecutionMode::LocalSize), rest @ ..] => Some(rest),
            _ => None,
        });
    let local_size: Vec<u32> =
        local_size.ok_or("no fixed workgroup size")?.iter().filter_map(literal).collect();
    interface.workgroup =
        local_size.try_into().map_err(|_| "a workgroup size that is no triple")?;

    for constant in &module.types_global_values {
        let Some(id) = constant.result_id else { continue };
        if let Some(number) = reader.decoration(id, None, Decoration::SpecId) {
            let (name, default) = (reader.name(id), reader.default(constant)?);
            interface.insert_constant(number, Constant { name, default })?;
        }
    }
    for variable in &module.types_global_values {
        let (Op::Variable, Some(id)) = (variable.class.opcode, variable.result_id) else {
            continue;
        };
        let Some(Operand::StorageClass(class)) = variable.operands.first() else { continue };
        let block = reader.pointee(variable)?;
        match class {
            StorageClass::StorageBuffer => {
                let number = |decoration| reader.decoration(id, None, decoration);
                let binding = number(Decoration::Binding).ok_or("a buffer without a binding")?;
                if number(Decoration::DescriptorSet) != Some(0) {
                    return Err(format!("binding {binding} is not in set 0"));
                }
                // Optimised modules drop unused variables; a variable that is kept but never used is
                // ignored too.
                if reader.is_used(id) {
                    let stride = reader.stride(block)?;
                    let access = Some(reader.access(id, block)?);
                    interface.insert(binding, Storage { stride, access })?;
                }
            }
            StorageClass::PushConstant => interface.params = reader.members(block)?,
            StorageClass::Workgroup => shared += reader.size(block)?,
            StorageClass::Uniform | StorageClass::UniformConstant => {
                return Err("a uniform buffer or image: kernels take storage buffers".into());
            }
            _ => {}
        }
    }
    let capabilities = module
        .capabilities
        .iter()
        .filter_map(|c| match c.operands.first() {
            Some(Operand::Capability(capability)) => Some(*capability),
            _ => None,
        })
        .collect();
    Ok((interface, Demands { capabilities, shared }))
}

/// Queries on a module's instructions.
struct Reader<'a> {
    module: &'a Module,
    by_id: HashMap<Word, &'a Instruction>,
}

impl<'a> Reader<'a> {
    fn new(module: &'a Module) -> Reader<'a> {
        let by_id =
            module.types_global_values.iter().filter_map(|i| Some((i.result_id?, i))).collect();
        Reader { module, by_id }
    }

    fn instruction(&self, id: Word) -> Result<&'a Instruction, String> {
        self.by_id.get(&id).copied().ok_or_else(|| format!("id {id} is not declared"))
    }

    /// The type behind a variable's pointer type.
    fn pointee(&self, variable: &Instruction) -> Result<Word, String> {
        let pointer = self.instruction(variable.result_type.ok_or("a variable without a type")?)?;
        pointer.operands.get(1).and_then(id_ref).ok_or_else(|| "a pointer to nothing".into())
    }

    fn is_used(&self, id: Word) -> bool {
        self.module.all_inst_iter().any(|instruction| {
            let names_it = instruction.operands.iter().any(|o| id_ref(o) == Some(id));
            let only_declares = matches!(
                instruction.class.opcode,
                Op::EntryPoint | Op::Decorate | Op::Name | Op::MemberDecorate | Op::MemberName
            );
            names_it && !only_declares
        })
    }

    /// A decoration's literal (0 if it has none) on an id, or on a member of a struct.
    fn decoration(&self, id: Word, member: Option<u32>, wanted: Decoration) -> Option<u32> {
        self.module.annotations.iter().find_map(|annotation| {
            let operands = annotation.operands.as_slice();
            let rest = match (annotation.class.opcode, member, operands) {
                (Op::Decorate, None, [Operand::IdRef(target), rest @ ..]) if *target == id => rest,
                (
                    Op::MemberDecorate,
                    Some(member),
                    [Operand::IdRef(target), Operand::LiteralBit32(at), rest @ ..],
                ) if *target == id && *at == member => rest,
                _ => return None,
            };
            match rest {
                [Operand::Decoration(found), rest @ ..] if *found == wanted => {
                    Some(rest.first().and_then(literal).unwrap_or(0))
                }
                _ => None,
            }
        })
    }

    /// The name that the source gives to an id, where the module has kept it.
    fn name(&self, id: Word) -> Option<String> {
        self.module.debug_names.iter().find_map(|name| match name.operands.as_slice() {
            [Operand::IdRef(target), Operand::LiteralString(name)] if *target == id => {
                Some(name.clone())
            }
            _ => None,
        })
    }

    /// The default of a specialisation constant.
    fn default(&self, constant: &Instruction) -> Result<ConstantValue, String> {
        match constant.class.opcode {
            Op::SpecConstantTrue => return Ok(ConstantValue::Bool(true)),
            Op::SpecConstantFalse => return Ok(ConstantValue::Bool(false)),
            _ => {}
        }
        let ty = self.instruction(constant.result_type.ok_or("a constant without a type")?)?;
        let word = constant.operands.first().and_then(literal).ok_or("a default without value")?;
        let numbers: Vec<u32> = ty.operands.iter().filter_map(literal).collect();
        match (ty.class.opcode, numbers.as_slice()) {
            (Op::TypeInt, [32, 0]) => Ok(ConstantValue::U32(word)),
            (Op::TypeInt, [32, 1]) => Ok(ConstantValue::I32(word as i32)),
            (Op::TypeFloat, [32, ..]) => Ok(ConstantValue::F32(f32::from_bits(word))),
            (other, numbers) => {
                Err(format!("a specialisation constant of the type {other:?} {numbers:?}"))
            }
        }
    }

    /// Access of a buffer, decorated on the variable or on every member of its block.
    fn access(&self, variable: Word, block: Word) -> Result<Access, String> {
        let members = self.instruction(block)?.operands.len() as u32;
        let has = |wanted| {
            self.decoration(variable, None, wanted).is_some()
                || (0..members).all(|m| self.decoration(block, Some(m), wanted).is_some())
        };
        match (has(Decoration::NonWritable), has(Decoration::NonReadable)) {
            (true, false) => Ok(Access::Read),
            (false, true) => Ok(Access::Write),
            (false, false) => Ok(Access::ReadWrite),
            (true, true) => Err("a buffer that may be neither read nor written".into()),
        }
    }

    fn members(&self, block: Word) -> Result<Vec<(u32, u32)>, String> {
        let mut members = Vec::new();
        for (at, operand) in self.instruction(block)?.operands.iter().enumerate() {
            let offset = self
                .decoration(block, Some(at as u32), Decoration::Offset)
                .ok_or("a member without an offset")?;
            members.push((offset, self.size(id_ref(operand).ok_or("a member without a type")?)?));
        }
        Ok(members)
    }

    fn stride(&self, block: Word) -> Result<u32, String> {
        let members = &self.instruction(block)?.operands;
        let last = members.last().and_then(id_ref).ok_or("an empty block")?;
        if self.instruction(last)?.class.opcode != Op::TypeRuntimeArray {
            return self.size(block);
        }
        if members.len() != 1 {
            return Err(MIXED.into());
        }
        self.decoration(last, None, Decoration::ArrayStride).ok_or_else(|| "no stride".into())
    }

    /// Size of a value of this type, bytes.
    fn size(&self, ty: Word) -> Result<u32, String> {
        let instruction = self.instruction(ty)?;
        let operands = &instruction.operands;
        let inner = || self.size(operands.first().and_then(id_ref).ok_or("a type of nothing")?);
        let number = |at: usize| operands.get(at).and_then(literal).ok_or("a type without a size");
        match instruction.class.opcode {
            Op::TypeBool => Ok(4),
            Op::TypeInt | Op::TypeFloat => Ok(number(0)? / 8),
            Op::TypeVector | Op::TypeMatrix => Ok(inner()? * number(1)?),
            Op::TypeArray => {
                let length = self.instruction(operands.get(1).and_then(id_ref).ok_or("length")?)?;
                let length = length.operands.first().and_then(literal).ok_or("array length")?;
                let stride = self.decoration(ty, None, Decoration::ArrayStride);
                Ok(length * stride.map_or_else(inner, Ok)?)
            }
            // Outside of a block (in shared memory) members have no offsets.
            Op::TypeStruct => match self.members(ty) {
                Ok(members) => Ok(members.last().map_or(0, |(offset, size)| offset + size)),
                Err(_) => operands.iter().filter_map(id_ref).map(|member| self.size(member)).sum(),
            },
            other => Err(format!("no size for {other:?}")),
        }
    }
}

fn id_ref(operand: &Operand) -> Option<Word> {
    match operand {
        Operand::IdRef(id) => Some(*id),
        _ => None,
    }
}

fn literal(operand: &Operand) -> Option<u32> {
    match operand {
        Operand::LiteralBit32(value) => Some(*value),
        _ => None,
    }
}
