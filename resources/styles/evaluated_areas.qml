<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22.0" styleCategories="Symbology|Fields|Forms|AttributeTable">
  <renderer-v2 type="singleSymbol" symbollevels="0" referencescale="-1" enableorderby="0" forceraster="0">
    <symbols>
      <symbol type="fill" clip_to_extent="1" name="0" force_rhr="0" alpha="1">
        <layer locked="0" class="SimpleFill" pass="0" enabled="1">
          <Option type="Map">
            <Option type="QString" value="0,114,178,60" name="color" />
            <Option type="QString" value="0,114,178,255" name="outline_color" />
            <Option type="QString" value="solid" name="outline_style" />
            <Option type="QString" value="0.6" name="outline_width" />
            <Option type="QString" value="MM" name="outline_width_unit" />
            <Option type="QString" value="solid" name="style" />
          </Option>
        </layer>
      </symbol>
    </symbols>
  </renderer-v2>
  <aliases>
    <alias name="Element" field="element_id" />
    <alias name="Class" field="class" />
    <alias name="Score" field="score" />
    <alias name="Length (m)" field="length_m" />
    <alias name="Reference" field="reference_id" />
    <alias name="DF (m)" field="frechet_m" />
    <alias name="IoU" field="iou" />
    <alias name="Lateral error, median (m)" field="lateral_median_m" />
    <alias name="Lateral error, 95 % (m)" field="lateral_p95_m" />
    <alias name="Share without reference" field="beyond_share" />
  </aliases>
  <attributetableconfig actionWidgetStyle="dropDown" sortOrder="0" sortExpression="">
    <columns>
      <column type="field" name="element_id" hidden="0" width="-1" />
      <column type="field" name="class" hidden="0" width="-1" />
      <column type="field" name="score" hidden="0" width="-1" />
      <column type="field" name="length_m" hidden="0" width="-1" />
      <column type="field" name="reference_id" hidden="0" width="-1" />
      <column type="field" name="frechet_m" hidden="0" width="-1" />
      <column type="field" name="iou" hidden="0" width="-1" />
      <column type="field" name="lateral_median_m" hidden="0" width="-1" />
      <column type="field" name="lateral_p95_m" hidden="0" width="-1" />
      <column type="field" name="beyond_share" hidden="0" width="-1" />
      <column type="field" name="fid" hidden="1" width="-1" />
      <column type="actions" hidden="1" width="-1" />
    </columns>
  </attributetableconfig>
  <layerGeometryType>2</layerGeometryType>
</qgis>
